"""Every linear solver on 1,000 exact draws, and on the draws that it cannot solve."""

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.epipolar import (
    essential_from_fundamental,
    homogeneous,
    poses_from_essential,
)
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp, random_rotation
from fieldstone.geometry.triangulation import choose_by_cheirality, triangulate_linear
from fieldstone.solve.minimal.eight_point import FundamentalEstimator, fundamental_eight_point
from fieldstone.solve.minimal.linear_pnp import PnpEstimator, pnp_linear, pose_from_matrix
from fieldstone.solve.robust.loss import cauchy
from fieldstone.solve.robust.nonlinear import pnp_nonlinear, triangulate_nonlinear
from fieldstone.solve.robust.ransac import RansacOptions, draw_samples, ransac, trials_needed
from matchers import assert_draws

CAMERA = Camera("SIMPLE_RADIAL", 800, 600, np.array([600.0, 400, 300, -0.03]))
K = CAMERA.calibration_matrix()
DRAWS = 1000


def two_view_draw(rng: np.random.Generator, count: int, *, angle: float = 0.3) -> tuple[Rigid3, np.ndarray]:
    """cam2_from_cam1 with |t| = 1 and points in front of both cameras."""
    t = rng.normal(size=3)
    pose = Rigid3(exp(angle * rng.normal(size=3)), t / np.linalg.norm(t))
    points = np.empty((0, 3))
    while len(points) < count:
        candidates = rng.uniform([-3, -3, 2], [3, 3, 10], size=(64, 3))
        points = np.concatenate([points, candidates[pose.apply(candidates)[:, 2] > 0.5]])
    return pose, points[:count]


def pose_error(found: Rigid3, truth: Rigid3) -> float:
    """The larger of those of R and t; |R1 - R2| is sqrt(2) times the angle between them, where that is small."""
    return float(max(np.linalg.norm(found.R - truth.R), np.linalg.norm(found.t - truth.t)))


def plane_coordinates(pose: Rigid3, points: np.ndarray) -> np.ndarray:
    moved = pose.apply(points)
    return moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("angle", [0.3, 1e-4], ids=["general", "near identity"])
def test_eight_point_to_pose_recovers_exact_data(angle):
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(DRAWS):
        pose, points = two_view_draw(rng, 12, angle=angle)
        uv1, uv2 = plane_coordinates(Rigid3.identity(), points), plane_coordinates(pose, points)
        pixels1, pixels2 = (homogeneous(uv) @ K[:2].T for uv in (uv1, uv2))
        F = fundamental_eight_point(pixels1, pixels2)
        candidates = poses_from_essential(essential_from_fundamental(F, K, K))
        found = candidates[choose_by_cheirality(candidates, uv1, uv2)[0]]
        errors.append(pose_error(found, pose))
    assert_draws(errors, below=1e-6, fraction=0.99)


def test_fundamental_has_rank_two_also_from_noise():
    rng = np.random.default_rng(1)
    F = fundamental_eight_point(rng.uniform(0, 800, size=(50, 20, 2)), rng.uniform(0, 800, size=(50, 20, 2)))
    d = np.linalg.svd(F, compute_uv=False)
    assert np.all(d[:, 2] < 1e-12 * d[:, 0])


def test_eight_point_on_a_plane_satisfies_the_matches_but_is_not_unique():
    rng = np.random.default_rng(2)
    pose, points = two_view_draw(rng, 20, angle=0.05)
    points[:, 2] = 5 + 0.3 * points[:, 0]
    pixels1, pixels2 = (plane_coordinates(T, points) * 600 + 300 for T in (Rigid3.identity(), pose))
    F = fundamental_eight_point(pixels1, pixels2)
    errors = FundamentalEstimator(pixels1, pixels2).squared_errors(F[None])
    assert errors.max() < 1e-12


@pytest.mark.parametrize("count", [6, 10])
def test_linear_pnp_recovers_exact_data(count):
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(DRAWS):
        pose = Rigid3(random_rotation(1, rng)[0], rng.normal(size=3))
        in_cam = rng.uniform([-3, -3, 2], [3, 3, 10], size=(count, 3))
        found = pose_from_matrix(pnp_linear(in_cam[:, :2] / in_cam[:, 2:], pose.inverse().apply(in_cam)))
        errors.append(pose_error(found, pose))
    assert_draws(errors, below=1e-6, fraction=0.99)


def test_linear_pnp_of_a_plane_or_a_line_is_nan():
    rng = np.random.default_rng(4)
    plane = rng.uniform([-3, -3, 5], [3, 3, 5], size=(8, 3))
    line = np.linspace(0, 1, 8)[:, None] * np.array([1.0, 2.0, 3.0]) + np.array([0, 0, 3.0])
    for points in (plane, line):
        assert np.all(np.isnan(pnp_linear(points[:, :2] / points[:, 2:], points)))


def test_solvers_refuse_too_few_data():
    with pytest.raises(ValueError, match="8 matches"):
        fundamental_eight_point(np.zeros((7, 2)), np.zeros((7, 2)))
    with pytest.raises(ValueError, match="6 points"):
        pnp_linear(np.zeros((5, 2)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="3 points"):
        pnp_nonlinear(CAMERA, Rigid3.identity(), np.zeros((9, 2)), np.full((9, 3), -1.0))
    estimator = FundamentalEstimator(np.zeros((7, 2)), np.zeros((7, 2)))
    assert ransac(estimator, RansacOptions(), np.random.default_rng(0)) is None


@pytest.mark.parametrize("outlier_share", [0.0, 0.2, 0.5])
def test_ransac_finds_the_fundamental_matrix_among_outliers(outlier_share):
    rng = np.random.default_rng(5)
    pose, points = two_view_draw(rng, 300, angle=0.1)
    pixels1, pixels2 = (plane_coordinates(T, points) * 600 + 300 for T in (Rigid3.identity(), pose))
    pixels2 = pixels2 + 0.3 * rng.normal(size=pixels2.shape)
    false = rng.random(300) < outlier_share
    pixels2[false] = rng.uniform(0, 600, size=(int(false.sum()), 2))
    result = ransac(FundamentalEstimator(pixels1, pixels2), RansacOptions(max_error_px=1.5), np.random.default_rng(6))
    assert result is not None
    assert result.inliers[~false].mean() > 0.97
    assert result.inliers[false].sum() <= 0.05 * max(false.sum(), 1) + 5
    again = ransac(FundamentalEstimator(pixels1, pixels2), RansacOptions(max_error_px=1.5), np.random.default_rng(6))
    assert again is not None
    np.testing.assert_array_equal(result.model, again.model)


def test_pnp_ransac_and_refinement_reach_the_noise():
    rng = np.random.default_rng(7)
    pose = Rigid3(random_rotation(1, rng)[0], rng.normal(size=3))
    in_cam = rng.uniform([-3, -2, 4], [3, 2, 12], size=(400, 3))
    world = pose.inverse().apply(in_cam)
    pixels = image_from_cam(CAMERA, in_cam) + 0.5 * rng.normal(size=(400, 2))
    pixels[:160] = rng.uniform(0, 600, size=(160, 2))
    result = ransac(PnpEstimator(CAMERA, pixels, world), RansacOptions(max_error_px=3.0), rng)
    assert result is not None
    assert result.inliers[160:].mean() > 0.97
    found = pnp_nonlinear(
        CAMERA, pose_from_matrix(result.model), pixels[result.inliers], world[result.inliers], loss=cauchy(1.0)
    )
    # 240 points at focal 600 with 0.5 px noise: the rotation is known to about 0.5 / 600 / sqrt(240) rad.
    assert angle_between(found.R, pose.R) < 10 * 0.5 / 600 / np.sqrt(240)


def test_nonlinear_triangulation_beats_linear_and_reaches_the_truth_on_exact_data():
    rng = np.random.default_rng(8)
    num_views, num_points = 4, 200
    poses = Rigid3(
        exp(0.1 * rng.normal(size=(num_views, 3))), np.stack([np.linspace(-1, 1, num_views)] + [np.zeros(4)] * 2, 1)
    )
    X = rng.uniform([-3, -2, 4], [3, 2, 12], size=(num_points, 3))
    view, point = np.divmod(np.arange(num_views * num_points), num_points)
    pixels = image_from_cam(CAMERA, poses[view].apply(X[point]))
    args = ([CAMERA], np.zeros(num_views, dtype=np.int64), poses, view, point)
    exact = triangulate_nonlinear(*args, pixels, X * (1 + 0.05 * rng.normal(size=X.shape)))
    np.testing.assert_allclose(exact, X, atol=1e-6)

    noisy = pixels + rng.normal(size=pixels.shape)
    uv = (noisy - CAMERA.principal_point) / CAMERA.focal
    linear = triangulate_linear(poses, uv.reshape(num_views, num_points, 2).transpose(1, 0, 2))
    refined = triangulate_nonlinear(*args, noisy, linear)

    def cost(points: np.ndarray) -> np.ndarray:
        errors = image_from_cam(CAMERA, poses[view].apply(points[point])) - noisy
        return np.bincount(point, weights=np.sum(errors**2, axis=1))

    assert np.all(cost(refined) <= cost(linear) + 1e-9)
    assert cost(refined).sum() < 0.99 * cost(linear).sum()
    for _ in range(20):  # a minimum: no neighbour is better
        assert np.all(cost(refined + 1e-4 * rng.normal(size=X.shape)) >= cost(refined) - 1e-6)


def test_samples_are_distinct_and_uniform():
    samples = draw_samples(9, 4, 20_000, np.random.default_rng(9))
    assert all(len(set(row)) == 4 for row in samples[:500])
    counts = np.bincount(samples.ravel(), minlength=9)
    expected = 20_000 * 4 / 9
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)
    assert samples.max() == 8


def test_number_of_trials_follows_the_formula():
    assert trials_needed(1.0, 8, 0.99) == 1
    assert trials_needed(0.5, 4, 0.99) == 72  # table 4.3 of Hartley and Zisserman
    assert trials_needed(0.0, 8, 0.99) > 10**12
