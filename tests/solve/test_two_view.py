"""Relative pose among outliers: truth, noise, determinism, degenerate input, and the kernels' derivatives."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.geometry.epipolar import essential_from_pose, homogeneous, poses_from_essential, sampson_error
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp
from fieldstone.solve.epipolar_numba import BLOCK, epipolar_normal_equations_numba, score_epipolar_numba
from fieldstone.solve.essential_numba import choose_pose_numba, other_rotation_numba, state_from_essential_numba
from fieldstone.solve.ransac import RansacOptions
from fieldstone.solve.two_view import TwoViewOptions, estimate_two_view, pixel_size_squared, sampson_errors
from matchers import check_jacobian

CAMERA1 = Camera("PINHOLE", 1600, 1200, np.array([1400.0, 1400.0, 805.0, 590.0]))
CAMERA2 = Camera("RADIAL", 1200, 1600, np.array([1100.0, 610.0, 790.0, -0.1, 0.02]))
OPTIONS = TwoViewOptions(RansacOptions(max_error_px=2.0, min_trials=30))


def draw(n: int, rng: np.random.Generator, *, noise_px: float = 0.0, outliers: float = 0.0, flat: bool = False):
    """cam2_from_cam1 with |t| = 1, pixels in both photos and the mask of true matches."""
    t = rng.normal(size=3)
    cam2_from_cam1 = Rigid3(exp(0.15 * rng.normal(size=3)), t / np.linalg.norm(t))
    pixels1, pixels2 = np.empty((0, 2)), np.empty((0, 2))
    while len(pixels1) < n:
        candidates = rng.uniform([0, 0], [CAMERA1.width, CAMERA1.height], size=(4 * n, 2))
        uv = plane_from_image(CAMERA1, candidates)
        z = 6.0 / (1.0 + uv @ np.array([0.3, 0.2])) if flat else rng.uniform(3, 9, size=len(uv))
        seen = image_from_cam(CAMERA2, cam2_from_cam1.apply(homogeneous(uv) * z[:, None]))
        inside = np.all((seen > 0) & (seen < [CAMERA2.width, CAMERA2.height]), axis=1)
        pixels1, pixels2 = np.concatenate([pixels1, candidates[inside]]), np.concatenate([pixels2, seen[inside]])
    pixels1, pixels2 = pixels1[:n], pixels2[:n] + noise_px * rng.normal(size=(n, 2))
    pixels1 = pixels1 + noise_px * rng.normal(size=(n, 2))
    wrong = rng.permutation(n) < round(outliers * n)
    pixels2[wrong] = rng.uniform([0, 0], [CAMERA2.width, CAMERA2.height], size=(wrong.sum(), 2))
    return cam2_from_cam1, pixels1, pixels2, ~wrong


def pose_error(found: Rigid3 | None, truth: Rigid3) -> float:
    """Larger of the angles of rotation and of translation direction, in radians."""
    assert found is not None
    direction = np.arctan2(np.linalg.norm(np.cross(found.t, truth.t)), found.t @ truth.t)
    return max(float(angle_between(found.R, truth.R)), float(direction))


def test_exact_matches_give_the_exact_pose():
    good = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        truth, pixels1, pixels2, true = draw(80, rng, outliers=0.3)
        found = estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2, OPTIONS, rng)
        good += pose_error(found.cam2_from_cam1, truth) < 1e-6 and found.inliers[true].all()
    assert good >= 99


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("with_quality", [False, True])
def test_noisy_matches_with_outliers(outliers, with_quality):
    rng = np.random.default_rng(1)
    truth, pixels1, pixels2, true = draw(1000, rng, noise_px=0.5, outliers=outliers)
    quality = true + rng.normal(size=len(true)) if with_quality else None
    found = estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2, OPTIONS, rng, quality=quality)
    assert found.kind == "calibrated"
    assert pose_error(found.cam2_from_cam1, truth) < np.deg2rad(1.0)
    assert found.inliers[true].mean() > 0.95
    # A wrong match agrees by chance within a band of 2 x 2 px around a line of about 1400 px.
    assert found.inliers[~true].sum() <= 20
    assert found.cam2_from_cam1 is not None
    np.testing.assert_allclose(found.matrix, essential_from_pose(found.cam2_from_cam1), atol=1e-12)


def test_the_same_seed_gives_the_same_geometry():
    _, pixels1, pixels2, _ = draw(300, np.random.default_rng(2), noise_px=0.5, outliers=0.5)
    a, b = (estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2, OPTIONS, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(a.matrix, b.matrix)
    np.testing.assert_array_equal(a.inliers, b.inliers)


def test_input_without_geometry():
    rng = np.random.default_rng(3)
    _, pixels1, pixels2, _ = draw(40, rng)
    for few in (0, 4, OPTIONS.min_inliers - 1):
        found = estimate_two_view(CAMERA1, CAMERA2, pixels1[:few], pixels2[:few], OPTIONS, rng)
        assert (found.kind, found.cam2_from_cam1, found.inliers.sum()) == ("degenerate", None, 0)
    lost = np.full_like(pixels2, np.nan)
    assert estimate_two_view(CAMERA1, CAMERA2, pixels1, lost, OPTIONS, rng).kind == "degenerate"
    with pytest.raises((ValueError, TypeCheckError), match="39"):
        estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2[:39], OPTIONS, rng)


def kernel_data(n: int, rng: np.random.Generator) -> tuple[Rigid3, np.ndarray]:
    truth, pixels1, pixels2, _ = draw(n, rng, noise_px=1.0, outliers=0.2)
    uv1, uv2 = plane_from_image(CAMERA1, pixels1), plane_from_image(CAMERA2, pixels2)
    sizes = [pixel_size_squared(CAMERA1, uv1)[None], pixel_size_squared(CAMERA2, uv2)[None]]
    return truth, np.ascontiguousarray(np.concatenate([uv1.T, uv2.T, *sizes]))


def test_errors_are_sampson_errors_in_pixels():
    """With one size of pixel everywhere: the reference on the plane, times the squared focal length."""
    truth, data = kernel_data(100, np.random.default_rng(4))
    data[4:] = 1.0 / 900.0**2
    x1, x2 = homogeneous(data[:2].T), homogeneous(data[2:4].T)
    expected = 900.0**2 * sampson_error(essential_from_pose(truth), x1, x2)
    found = sampson_errors(np.concatenate([truth.R.ravel(), truth.t]), data)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("n", [1, BLOCK, 3 * BLOCK + 5])
@pytest.mark.parametrize("kernel", [score_epipolar_numba, score_epipolar_numba.py_func])
def test_score_is_the_truncated_sum(n, kernel):
    truth, data = kernel_data(n, np.random.default_rng(5))
    errors = sampson_errors(np.concatenate([truth.R.ravel(), truth.t]), data)
    cost, inliers, seen = kernel(essential_from_pose(truth).ravel(), data, 4.0, np.inf, 0.0, 0.0, np.inf)
    np.testing.assert_allclose(cost, np.minimum(errors, 4.0).sum(), rtol=1e-9)
    assert (inliers, seen) == ((errors < 4.0).sum(), n)


@pytest.mark.parametrize("softness", [0.0, 0.8])
def test_normal_equations_are_the_derivative_of_the_cost(softness):
    truth, data = kernel_data(150, np.random.default_rng(6))
    E = essential_from_pose(truth).ravel()
    S = np.empty((10, 10))
    cost, _ = epipolar_normal_equations_numba(E, data, 9.0, softness, np.empty(10 * BLOCK), S)

    def cost_after(delta: np.ndarray) -> np.ndarray:
        x1, x2 = np.ones((3, 150)), np.ones((3, 150))
        x1[:2], x2[:2] = data[:2], data[2:4]
        M = (E + delta).reshape(3, 3)
        p, q = M @ x1, M.T @ x2
        D = data[5] * (p[0] ** 2 + p[1] ** 2) + data[4] * (q[0] ** 2 + q[1] ** 2)
        squared = np.minimum(np.sum(x2 * p, axis=0) ** 2 / D, 9.0)
        return np.sum(squared / (1 + softness * squared))

    np.testing.assert_allclose(cost, cost_after(np.zeros(9)), rtol=1e-9)
    check_jacobian(cost_after, 2 * S[9, :9], size=9, rtol=1e-5)


def test_poses_of_an_essential_matrix_are_the_four():
    """Against the decomposition by singular values."""
    rng = np.random.default_rng(7)
    for _ in range(200):
        t = rng.normal(size=3)
        E = essential_from_pose(Rigid3(exp(rng.normal(size=3)), t / np.linalg.norm(t))) * rng.uniform(0.1, 10)
        expected = poses_from_essential(E)
        state = np.empty(12)
        state_from_essential_numba(E.ravel(), state)
        for _ in range(2):
            R, t = state[:9].reshape(3, 3).copy(), state[9:].copy()
            for sign in (1.0, -1.0):
                assert min(np.abs(R - p.R).max() + np.abs(sign * t - p.t).max() for p in expected) < 1e-9
            other_rotation_numba(state)


def test_cheirality_is_that_of_the_truth():
    truth, data = kernel_data(100, np.random.default_rng(8))
    state, inliers = np.empty(12), np.empty(100, dtype=bool)
    state_from_essential_numba(essential_from_pose(truth).ravel(), state)
    count = choose_pose_numba(state, data, 9.0, inliers)
    assert count == inliers.sum() > 70
    assert pose_error(Rigid3(state[:9].reshape(3, 3), state[9:]), truth) < 1e-6
