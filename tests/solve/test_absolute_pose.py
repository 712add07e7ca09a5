"""Absolute pose among outliers: truth, noise, determinism, degenerate input, and the kernels' derivatives."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp, random_rotation
from fieldstone.solve.robust.absolute_pose import estimate_absolute_pose, plane_to_pixels, squared_errors
from fieldstone.solve.robust.early_test_numba import ACCEPT_ALL
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.reprojection_numba import BLOCK, pose_normal_equations_numba, score_pose_numba
from matchers import assert_rigid3_near, check_jacobian

PINHOLE = Camera("PINHOLE", 1600, 1200, np.array([1400.0, 1380.0, 805.0, 590.0]))
LENS = Camera("OPENCV", 1600, 1200, np.array([1400.0, 1380.0, 805.0, 590.0, -0.2, 0.05, 1e-3, -1e-3]))
OPTIONS = RansacOptions(max_error_px=3.0)


def draw(camera: Camera, n: int, rng: np.random.Generator, *, noise_px: float = 0.0, outliers: float = 0.0, flat=False):
    """cam_from_world, pixels, points and the mask of true correspondences."""
    cam_from_world = Rigid3(random_rotation(1, rng)[0], rng.normal(size=3))
    uv = plane_from_image(camera, rng.uniform([0, 0], [camera.width, camera.height], size=(n, 2)))
    z = 6.0 / (1.0 + uv @ np.array([0.3, 0.2])) if flat else rng.uniform(3, 9, size=n)
    in_cam = np.concatenate([uv, np.ones((n, 1))], axis=1) * z[:, None]
    pixels = image_from_cam(camera, in_cam) + noise_px * rng.normal(size=(n, 2))
    wrong = rng.permutation(n) < round(outliers * n)
    pixels[wrong] = rng.uniform([0, 0], [camera.width, camera.height], size=(wrong.sum(), 2))
    return cam_from_world, pixels, cam_from_world.inverse().apply(in_cam), ~wrong


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=lambda c: c.model)
@pytest.mark.parametrize("flat", [False, True])
def test_exact_data_gives_the_exact_pose(camera, flat):
    good = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        truth, pixels, points, true = draw(camera, 60, rng, outliers=0.4, flat=flat)
        found = estimate_absolute_pose(camera, pixels, points, OPTIONS, rng)
        assert found is not None
        good += angle_between(found.cam_from_world.R, truth.R) < 1e-6 and found.inliers[true].all()
    assert good >= 99


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=lambda c: c.model)
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5, 0.7, 0.9])
def test_noisy_data_with_outliers(camera, outliers):
    """The rotation error stays within a few times noise / (focal sqrt(inliers))."""
    rng = np.random.default_rng(1)
    truth, pixels, points, true = draw(camera, 1000, rng, noise_px=0.5, outliers=outliers)
    found = estimate_absolute_pose(camera, pixels, points, OPTIONS, rng)
    assert found is not None
    expected = 0.5 / camera.focal[0] / np.sqrt(true.sum())
    assert_rigid3_near(found.cam_from_world, truth, angle=10 * expected, distance=60 * expected)
    assert found.inliers[true].mean() > 0.99
    assert found.inliers[~true].sum() <= 10


def test_the_same_seed_gives_the_same_pose():
    _, pixels, points, _ = draw(PINHOLE, 300, np.random.default_rng(2), noise_px=0.5, outliers=0.6)
    a, b = (estimate_absolute_pose(PINHOLE, pixels, points, OPTIONS, np.random.default_rng(5)) for _ in range(2))
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.cam_from_world.R, b.cam_from_world.R)
    np.testing.assert_array_equal(a.inliers, b.inliers)


def test_input_that_has_no_pose():
    rng = np.random.default_rng(3)
    _, pixels, points, _ = draw(PINHOLE, 40, rng)
    assert estimate_absolute_pose(PINHOLE, pixels[:3], points[:3], OPTIONS, rng) is None
    assert estimate_absolute_pose(PINHOLE, pixels[:0], points[:0], OPTIONS, rng) is None
    assert estimate_absolute_pose(PINHOLE, pixels, np.ones_like(points), OPTIONS, rng) is None
    assert estimate_absolute_pose(PINHOLE, pixels, np.full_like(points, np.nan), OPTIONS, rng) is None
    with pytest.raises((ValueError, TypeCheckError), match="39"):
        estimate_absolute_pose(PINHOLE, pixels, points[:39], OPTIONS, rng)


def test_broken_correspondences_count_as_outliers():
    rng = np.random.default_rng(4)
    truth, pixels, points, _ = draw(PINHOLE, 50, rng)
    pixels[3], points[7, 1] = np.nan, np.inf
    found = estimate_absolute_pose(PINHOLE, pixels, points, OPTIONS, rng)
    assert found is not None
    assert_rigid3_near(found.cam_from_world, truth)
    assert np.flatnonzero(~found.inliers).tolist() == [3, 7]


def kernel_data(camera: Camera, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    truth, pixels, points, _ = draw(camera, n, rng, noise_px=1.0, outliers=0.2)
    uv = plane_from_image(camera, pixels)
    data = np.ascontiguousarray(np.concatenate([uv.T, points.T, plane_to_pixels(camera, uv)]))
    return np.concatenate([truth.R.ravel(), truth.t]), data


def test_errors_are_those_of_the_lens():
    """Against the projection itself, for errors small enough that the lens is linear."""
    rng = np.random.default_rng(5)
    truth, pixels, points, _ = draw(LENS, 200, rng, noise_px=0.01)
    uv = plane_from_image(LENS, pixels)
    data = np.concatenate([uv.T, points.T, plane_to_pixels(LENS, uv)])
    expected = np.linalg.norm(image_from_cam(LENS, truth.apply(points)) - pixels, axis=1)
    found = np.sqrt(squared_errors(np.concatenate([truth.R.ravel(), truth.t]), data))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("n", [1, BLOCK, 3 * BLOCK + 5])
@pytest.mark.parametrize("kernel", [score_pose_numba, score_pose_numba.py_func])
def test_score_is_the_truncated_sum(n, kernel):
    pose, data = kernel_data(LENS, n, np.random.default_rng(6))
    errors = squared_errors(pose, data)
    cost, inliers, seen = kernel(pose, data, 4.0, np.inf, ACCEPT_ALL)
    np.testing.assert_allclose(cost, np.minimum(errors, 4.0).sum(), rtol=1e-9)
    assert (inliers, seen) == ((errors < 4.0).sum(), n)


@pytest.mark.parametrize("softness", [0.0, 0.8])
def test_normal_equations_are_the_derivative_of_the_cost(softness):
    pose, data = kernel_data(LENS, 150, np.random.default_rng(7))
    S = np.empty((7, 7))
    cost, _ = pose_normal_equations_numba(pose, data, 9.0, softness, np.empty(14 * BLOCK), S)

    def cost_after(tangent: np.ndarray) -> np.ndarray:
        Q = exp(tangent[:3])
        moved = np.concatenate([(Q @ pose[:9].reshape(3, 3)).ravel(), Q @ pose[9:] + tangent[3:]])
        squared = np.minimum(squared_errors(moved, data), 9.0)
        return np.sum(squared / (1 + softness * squared))

    np.testing.assert_allclose(cost, cost_after(np.zeros(6)), rtol=1e-9)
    check_jacobian(cost_after, 2 * S[6, :6], size=6, rtol=1e-5)
