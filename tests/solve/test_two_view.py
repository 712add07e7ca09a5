"""Relative pose among outliers: truth, noise, determinism, degenerate input, and the kernels' derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.geometry.epipolar import essential_from_pose, homogeneous, poses_from_essential, sampson_error
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp
from fieldstone.solve.robust.early_test_numba import ACCEPT_ALL
from fieldstone.solve.robust.epipolar_numba import (
    BLOCK,
    epipolar_errors_numba,
    epipolar_normal_equations_numba,
    score_epipolar_numba,
)
from fieldstone.solve.robust.essential_numba import choose_pose_numba, other_rotation_numba, state_from_essential_numba
from fieldstone.solve.robust.homography import homography_normal_equations_numba
from fieldstone.solve.robust.match_data import match_data
from fieldstone.solve.robust.plane_or_rotation import motions_of_plane, transfer_errors
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view
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
    return truth, match_data(CAMERA1, CAMERA2, pixels1, pixels2, rng).columns


def errors_of(M: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Squared Sampson error in pixels, written as in the book."""
    x1, x2 = homogeneous(data[:2].T).T, homogeneous(data[2:4].T).T
    p, q = M @ x1, M.T @ x2
    return np.sum(x2 * p, axis=0) ** 2 / (data[5] * (p[0] ** 2 + p[1] ** 2) + data[4] * (q[0] ** 2 + q[1] ** 2))


def test_errors_are_sampson_errors_in_pixels():
    """With one size of pixel everywhere: the reference on the plane, times the squared focal length."""
    truth, data = kernel_data(100, np.random.default_rng(4))
    data[4:] = 1.0 / 900.0**2
    E = essential_from_pose(truth)
    expected = 900.0**2 * sampson_error(E, homogeneous(data[:2].T), homogeneous(data[2:4].T))
    errors = np.empty(100)
    epipolar_errors_numba(E.ravel(), data, errors)
    np.testing.assert_allclose(errors, expected, rtol=1e-9)
    np.testing.assert_allclose(errors_of(E, data), expected, rtol=1e-9)


@pytest.mark.parametrize("n", [1, BLOCK, 3 * BLOCK + 5])
@pytest.mark.parametrize("kernel", [score_epipolar_numba, score_epipolar_numba.py_func])
def test_score_is_the_truncated_sum(n, kernel):
    truth, data = kernel_data(n, np.random.default_rng(5))
    errors = errors_of(essential_from_pose(truth), data)
    cost, inliers, seen = kernel(essential_from_pose(truth).ravel(), data, 4.0, np.inf, ACCEPT_ALL)
    np.testing.assert_allclose(cost, np.minimum(errors, 4.0).sum(), rtol=1e-9)
    assert (inliers, seen) == ((errors < 4.0).sum(), n)


@pytest.mark.parametrize("softness", [0.0, 0.8])
def test_normal_equations_are_the_derivative_of_the_cost(softness):
    truth, data = kernel_data(150, np.random.default_rng(6))
    E = essential_from_pose(truth).ravel()
    S = np.empty((10, 10))
    cost, _ = epipolar_normal_equations_numba(E, data, 9.0, softness, np.empty(10 * BLOCK), S)

    def cost_after(delta: np.ndarray) -> np.ndarray:
        squared = np.minimum(errors_of((E + delta).reshape(3, 3), data), 9.0)
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
    state = np.empty(12)
    state_from_essential_numba(essential_from_pose(truth).ravel(), state)
    inliers = errors_of(essential_from_pose(truth), data) < 9.0
    count = choose_pose_numba(state, data, inliers)
    assert count == inliers.sum() > 70
    assert pose_error(Rigid3(state[:9].reshape(3, 3), state[9:]), truth) < 1e-6


def rotation_draw(n: int, rng: np.random.Generator, *, noise_px: float, outliers: float):
    """A camera that only turned."""
    R = exp(np.array([0.05, 0.2, -0.1]))
    pixels1 = rng.uniform([200, 200], [1400, 1000], size=(n, 2))
    uv = plane_from_image(CAMERA1, pixels1)
    pixels2 = image_from_cam(CAMERA1, homogeneous(uv) @ R.T) + noise_px * rng.normal(size=(n, 2))
    wrong = rng.permutation(n) < round(outliers * n)
    pixels2[wrong] = rng.uniform([0, 0], [CAMERA1.width, CAMERA1.height], size=(wrong.sum(), 2))
    return R, pixels1, pixels2


@pytest.mark.parametrize("seed", range(5))
def test_pure_rotation_is_panoramic(seed):
    rng = np.random.default_rng(seed)
    R, pixels1, pixels2 = rotation_draw(400, rng, noise_px=0.5, outliers=0.3)
    found = estimate_two_view(CAMERA1, CAMERA1, pixels1, pixels2, OPTIONS, rng)
    assert found.kind == "panoramic"
    assert found.cam2_from_cam1 is not None
    assert not found.cam2_from_cam1.t.any()
    assert angle_between(found.cam2_from_cam1.R, R) < np.deg2rad(0.05)
    K = CAMERA1.calibration_matrix()
    np.testing.assert_allclose(found.matrix, K @ found.cam2_from_cam1.R @ np.linalg.inv(K))


def test_copies_of_a_photo_show_no_motion_whatever_is_said_of_their_cameras():
    """With two focal lengths they would be a plane, seen from two distances."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [CAMERA1.width, CAMERA1.height], size=(300, 2))
    longer = replace(CAMERA1, params=CAMERA1.params * np.where(np.arange(len(CAMERA1.params)) < 2, 1.5, 1.0))
    found = estimate_two_view(CAMERA1, longer, pixels, pixels + 0.2 * rng.normal(size=(300, 2)), OPTIONS, rng)
    assert found.kind == "panoramic"
    assert found.cam2_from_cam1 is not None
    assert not found.cam2_from_cam1.t.any()
    assert found.inliers.all()


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_is_planar_and_keeps_its_pose(seed):
    """A plane leaves two motions; one of them is the truth, and the homography holds for its matches."""
    rng = np.random.default_rng(seed)
    _, pixels1, pixels2, true = draw(400, rng, noise_px=0.3, outliers=0.3, flat=True)
    found = estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2, OPTIONS, rng)
    assert found.kind == "planar"
    assert found.cam2_from_cam1 is not None
    assert found.inliers[true].mean() > 0.9
    uncalibrated = estimate_two_view(
        CAMERA1, CAMERA2, pixels1, pixels2, TwoViewOptions(OPTIONS.ransac, focal_known=False), rng
    )
    assert uncalibrated.kind == "planar"
    for result in (found, uncalibrated):
        ideal1, ideal2 = ideal_pixels(CAMERA1, pixels1[true]), ideal_pixels(CAMERA2, pixels2[true])
        mapped = homogeneous(ideal1) @ result.matrix.T
        assert np.median(np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - ideal2, axis=1)) < 1.0


def ideal_pixels(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    return plane_from_image(camera, pixels) * camera.focal + camera.principal_point


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_fundamental_matrix_with_a_dominant_plane(share):
    """Matches off the plane that took no part keep small errors: F is not the plane's alone."""
    failures = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        truth, a1, a2, _ = draw(400, rng, noise_px=0.3)
        on_plane = round(share * 400)
        if on_plane:
            flat1, flat2 = plane_of(truth, a1[:on_plane], rng)
            a1, a2 = np.concatenate([flat1, a1[on_plane:]]), np.concatenate([flat2, a2[on_plane:]])
        options = TwoViewOptions(OPTIONS.ransac, focal_known=False, planar_ratio=0.95)
        found = estimate_two_view(CAMERA1, CAMERA2, a1, a2, options, rng)
        assert found.kind == "uncalibrated"
        failures += found.inliers[on_plane:].mean() < 0.9
    assert failures <= 1


def plane_of(pose: Rigid3, pixels1: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Matches of points on a plane in front of the first camera."""
    uv = plane_from_image(CAMERA1, pixels1)
    z = 6.0 / (1.0 + uv @ np.array([0.3, 0.2]))
    moved = image_from_cam(CAMERA2, pose.apply(homogeneous(uv) * z[:, None]))
    seen = np.asarray(np.isfinite(moved).all(axis=1))
    fill = np.flatnonzero(seen)[rng.integers(seen.sum(), size=len(seen))]
    rows = np.where(seen, np.arange(len(seen)), fill)
    return pixels1[rows], moved[rows] + 0.3 * rng.normal(size=(len(rows), 2))


def test_f_agrees_with_the_pose_on_exact_matches():
    rng = np.random.default_rng(9)
    truth, pixels1, pixels2, _ = draw(100, rng)
    found = estimate_two_view(CAMERA1, CAMERA2, pixels1, pixels2, TwoViewOptions(focal_known=False), rng)
    K1, K2 = CAMERA1.calibration_matrix(), CAMERA2.calibration_matrix()
    E = K2.T @ found.matrix @ K1
    E /= np.linalg.norm(E)
    expected = essential_from_pose(truth) / np.linalg.norm(essential_from_pose(truth))
    assert min(np.abs(E - expected).max(), np.abs(E + expected).max()) < 1e-6


@pytest.mark.parametrize("softness", [0.0, 0.8])
def test_homography_normal_equations_are_the_derivative_of_the_cost(softness):
    rng = np.random.default_rng(10)
    R, pixels1, pixels2 = rotation_draw(150, rng, noise_px=1.0, outliers=0.2)
    data = match_data(CAMERA1, CAMERA1, pixels1, pixels2, rng).as_transfer(np.ones(150, dtype=bool))
    S = np.empty((9, 9))
    cost, _ = homography_normal_equations_numba(R.ravel(), data, 9.0, softness, np.empty(12 * BLOCK), S)

    def cost_after(delta: np.ndarray) -> np.ndarray:
        D = np.eye(3) + np.append(delta, 0.0).reshape(3, 3)
        squared = np.minimum(transfer_errors(D @ R, data), 9.0)
        return np.sum(squared / (1 + softness * squared))

    np.testing.assert_allclose(cost, cost_after(np.zeros(8)), rtol=1e-9)
    check_jacobian(cost_after, 2 * S[8, :8], size=8, rtol=1e-5)


def test_motions_of_a_plane_contain_the_truth():
    rng = np.random.default_rng(11)
    truth = Rigid3.identity()
    for _ in range(300):
        t, n = rng.normal(size=3), rng.normal(size=3)
        truth = Rigid3(exp(0.5 * rng.normal(size=3)), t / np.linalg.norm(t))
        H = rng.uniform(0.1, 5) * (truth.R + np.outer(truth.t, 0.3 * n))
        if np.linalg.det(H) <= 0:
            continue
        errors = [
            angle_between(m.R, truth.R) + min(np.abs(m.t - truth.t).max(), np.abs(m.t + truth.t).max())
            for m in motions_of_plane(H)
        ]
        assert min(errors) < 1e-6
    assert motions_of_plane(truth.R) == []
