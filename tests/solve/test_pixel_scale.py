"""A photo's pixel scale: its pixels, its camera and its scale times s are the same photo, so poses are the same."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from bundle_worlds import mixed_problem, perturbed
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import random_rotation
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.covariance import bundle_covariance
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_residuals
from fieldstone.solve.bundle.schur import normal_equations
from fieldstone.solve.bundle.scipy_reference import bundle_adjust_scipy
from fieldstone.solve.robust.absolute_pose import estimate_absolute_pose
from fieldstone.solve.robust.loss import cauchy
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.triangulation import triangulate_robust
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view

TIGHT = BundleOptions(relative_tolerance=1e-13, max_iterations=300, loss="cauchy")
CAMERA1 = Camera("OPENCV", 1600, 1200, np.array([1400.0, 1380.0, 805.0, 590.0, -0.1, 0.02, 1e-3, -1e-3]))
CAMERA2 = Camera("PINHOLE", 1200, 1600, np.array([1100.0, 1100.0, 610.0, 790.0]))


def enlarged(camera: Camera, s: float) -> Camera:
    """The camera of the same photo with s times as many pixels a side."""
    params = camera.params.copy()
    params[: camera.spec.num_focal + 2] *= s
    return replace(camera, width=round(s * camera.width), height=round(s * camera.height), params=params)


def rescaled(problem: BundleProblem, scales: tuple[float, ...]) -> BundleProblem:
    """The problem with the photos of camera c in `scales[c]` times as many pixels."""
    scale_of_view = np.array(scales)[problem.camera_of_view]
    return replace(
        problem,
        cameras=tuple(enlarged(camera, s) for camera, s in zip(problem.cameras, scales, strict=True)),
        pixels=problem.pixels * scale_of_view[problem.view, None],
        pixel_scale=scale_of_view,
    )


def assert_the_same_bundle(found: BundleProblem, expected: BundleProblem, scales: tuple[float, ...], atol: float):
    np.testing.assert_allclose(found.cam_from_world.R, expected.cam_from_world.R, atol=atol)
    np.testing.assert_allclose(found.cam_from_world.t, expected.cam_from_world.t, atol=atol)
    np.testing.assert_allclose(found.points, expected.points, atol=atol)
    for camera, reference, s in zip(found.cameras, expected.cameras, scales, strict=True):
        np.testing.assert_allclose(camera.params, enlarged(reference, s).params, rtol=atol, atol=atol)


@pytest.mark.parametrize("scales", [(2.0, 1.0, 0.5), (3.25, 1.7, 0.4)])
def test_bundle_adjustment_does_not_see_the_number_of_pixels(scales):
    problem = perturbed(mixed_problem(), scale=0.3)
    expected = bundle_adjust(problem, TIGHT)
    found = bundle_adjust(rescaled(problem, scales), TIGHT)
    assert found.initial_cost == pytest.approx(expected.initial_cost, rel=1e-9)
    assert found.final_cost == pytest.approx(expected.final_cost, rel=1e-9)
    assert_the_same_bundle(found.problem, expected.problem, scales, atol=1e-6)


def test_ones_give_the_same_bits_as_no_scale():
    problem = perturbed(mixed_problem())
    ones = replace(problem, pixel_scale=np.ones(problem.num_views))
    a, b = bundle_adjust(problem, TIGHT), bundle_adjust(ones, TIGHT)
    assert a.costs == b.costs
    np.testing.assert_array_equal(a.problem.points, b.problem.points)
    np.testing.assert_array_equal(a.problem.cam_from_world.R, b.problem.cam_from_world.R)


def test_minimum_with_scales_is_that_of_scipy():
    problem = perturbed(mixed_problem(), scale=0.3)
    problem = replace(problem, pixel_scale=np.array([1.0, 0.5, 3.0, 1.0, 2.0, 0.7]))
    found = bundle_adjust(problem, TIGHT)
    oracle = bundle_adjust_scipy(problem, loss=cauchy(1.0), relative_tolerance=1e-14, max_evaluations=300)
    assert found.final_cost == pytest.approx(oracle.final_cost, rel=1e-6)
    assert found.final_cost == pytest.approx(normal_equations(found.problem, cauchy(1.0), np.zeros(3)).cost, rel=1e-12)
    np.testing.assert_allclose(found.problem.points, oracle.problem.points, atol=1e-3)


def test_a_view_of_large_scale_hardly_counts():
    problem = mixed_problem(noise_px=0.0)
    pixels = problem.pixels.copy()
    pixels[problem.view == 4] += 30.0
    scale = np.where(np.arange(6) == 4, 1e6, 1.0)
    found = bundle_adjust(perturbed(replace(problem, pixels=pixels, pixel_scale=scale)), TIGHT).problem
    errors = np.linalg.norm(reprojection_residuals(replace(found, pixel_scale=None)), axis=1)
    assert errors[found.view != 4].max() < 1e-4


def test_covariance_does_not_see_the_number_of_pixels():
    scales = (3.25, 1.7, 0.4)
    problem = replace(mixed_problem(), fixed_views=np.isin(np.arange(6), (0, 4)))
    expected, found = bundle_covariance(problem), bundle_covariance(rescaled(problem, scales))
    np.testing.assert_allclose(found.of_views, expected.of_views, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found.of_points, expected.of_points, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("scale", [np.ones(5), np.zeros(6), np.full(6, np.nan)])
def test_bad_scales_are_refused(scale):
    with pytest.raises((ValueError, TypeCheckError), match=r"pixel.scale"):
        replace(mixed_problem(), pixel_scale=scale)


def scene(seed: int, *, noise_px: float = 0.4) -> tuple[Rigid3, np.ndarray, np.ndarray, np.ndarray]:
    """cam2_from_cam1, points in the first camera and their pixels in both photos, a fifth of them wrong."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], size=(200, 3))
    cam2_from_cam1 = Rigid3(np.eye(3), np.array([-0.8, 0.1, 0.2]))
    pixels1 = image_from_cam(CAMERA1, points) + noise_px * rng.normal(size=(200, 2))
    pixels2 = image_from_cam(CAMERA2, cam2_from_cam1.apply(points)) + noise_px * rng.normal(size=(200, 2))
    pixels2[:40] = rng.uniform([0, 0], [CAMERA2.width, CAMERA2.height], size=(40, 2))
    return cam2_from_cam1, points, pixels1, pixels2


@pytest.mark.parametrize("focal_known", [True, False])
def test_two_views_do_not_see_the_number_of_pixels(focal_known):
    _, _, pixels1, pixels2 = scene(0)
    options = TwoViewOptions(RansacOptions(max_error_px=1.5, min_trials=30), focal_known=focal_known)
    expected = estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2, options, np.random.default_rng(5))
    s1, s2 = 2.6, 0.75
    found = estimate_two_view(
        enlarged(CAMERA1, s1), enlarged(CAMERA2, s2), s1 * pixels1, s2 * pixels2, options,
        np.random.default_rng(5), pixel_scales=(s1, s2),
    )  # fmt: skip
    assert found.kind == expected.kind == ("calibrated" if focal_known else "uncalibrated")
    np.testing.assert_array_equal(found.inliers, expected.inliers)
    if focal_known:
        np.testing.assert_allclose(found.matrix, expected.matrix, atol=1e-6)
    else:
        F = np.diag([s2, s2, 1.0]) @ found.matrix @ np.diag([s1, s1, 1.0])
        F *= np.linalg.norm(expected.matrix) / np.linalg.norm(F)
        np.testing.assert_allclose(F * np.sign(np.sum(F * expected.matrix)), expected.matrix, atol=1e-6)


def test_absolute_pose_needs_no_scale_but_that_of_its_threshold():
    rng = np.random.default_rng(1)
    _, points, pixels, _ = scene(1)
    world_from_cam = Rigid3(random_rotation(1, rng)[0], rng.normal(size=3))
    in_world, s = world_from_cam.apply(points), 2.6
    expected, found = (
        estimate_absolute_pose(
            enlarged(CAMERA1, k), k * pixels, in_world, RansacOptions(max_error_px=3.0 * k), np.random.default_rng(5)
        )
        for k in (1.0, s)
    )
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found.inliers, expected.inliers)
    np.testing.assert_allclose(found.cam_from_world.R, expected.cam_from_world.R, atol=1e-6)
    np.testing.assert_allclose(found.cam_from_world.t, expected.cam_from_world.t, atol=1e-6)


def test_triangulation_takes_focal_lengths_in_scaled_pixels():
    """A threshold of 2 of the first photo's pixels and 2 * scale of the second's is 2 with f / scale."""
    cam2_from_cam1, points, _, _ = scene(2)
    poses = Rigid3.stack([Rigid3.identity(), cam2_from_cam1, Rigid3(np.eye(3), np.array([0.9, 0.0, 0.1]))])
    view = np.tile(np.arange(3), 200)
    in_cam = poses[view].apply(np.repeat(points, 3, axis=0))
    uv = in_cam[:, :2] / in_cam[:, 2:]
    uv[view == 2, 1] += 5.0 / 1000.0  # 5 px of the third photo
    starts = np.arange(0, 601, 3)
    for scale, agrees in ((1.0, False), (4.0, True)):
        focal = np.array([1000.0, 1000.0, 1000.0]) / np.array([1.0, 1.0, scale])
        xyz, inliers = triangulate_robust(poses, focal, view, uv, starts, max_error_px=2.0, min_angle=np.deg2rad(1.5))
        assert inliers[view != 2].mean() > 0.99
        assert (inliers[view == 2].mean() > 0.99) == agrees
        assert np.isfinite(xyz).all()
