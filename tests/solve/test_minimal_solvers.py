"""Minimal solvers on 1,000 exact draws each, against the equations they solve and the pose that made the data."""

import numpy as np
import pytest

from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp, random_rotation
from fieldstone.geometry.triangulation import bearings
from fieldstone.solve.algebra.null_space_numba import null_space_numba
from fieldstone.solve.algebra.polynomial_roots import real_roots_numba, real_roots_of_cubic, real_roots_of_quadratic
from fieldstone.solve.minimal.five_point import five_point
from fieldstone.solve.minimal.p3p import p3p
from fieldstone.solve.minimal.seven_point import seven_point
from fieldstone.solve.robust.fundamental_numba import plane_and_parallax_numba, set_rank_two_numba
from fieldstone.solve.robust.homography import homography_four_point
from matchers import assert_draws

DRAWS = 1000


def nearest_pose_error(poses: list[Rigid3], truth: Rigid3) -> float:
    """Of the nearest pose, in R and t; |R1 - R2| is sqrt(2) times the angle between them, where that is small."""
    off = (max(float(np.linalg.norm(p.R - truth.R)), float(np.linalg.norm(p.t - truth.t))) for p in poses)
    return min(off, default=np.inf)


def p3p_draw(kind: str, rng: np.random.Generator) -> tuple[Rigid3, np.ndarray, np.ndarray]:
    """cam_from_world, unit bearings and points of one draw; depths 1 to 10."""
    cam_from_world = Rigid3(random_rotation(1, rng)[0], rng.normal(size=3))
    if kind == "near identity":
        cam_from_world = Rigid3(exp(1e-4 * rng.normal(size=3)), 1e-4 * rng.normal(size=3))
    uv = rng.uniform(-1, 1, size=(3, 2))
    if kind == "narrow":
        uv = 0.02 * uv + rng.uniform(-0.5, 0.5, size=2)
    y = bearings(uv)
    depths = rng.uniform(1, 10, size=3)
    if kind == "equal depths":
        depths[:] = depths[0]
    return cam_from_world, y, cam_from_world.inverse().apply(y * depths[:, None])


@pytest.mark.parametrize("kind", ["general", "near identity", "equal depths", "narrow"])
def test_p3p_recovers_exact_poses(kind):
    rng = np.random.default_rng(0)
    errors, residuals = [], []
    for _ in range(DRAWS):
        truth, y, X = p3p_draw(kind, rng)
        poses = p3p(y, X)
        errors.append(nearest_pose_error(poses, truth))
        residuals.append(max((p3p_residual(pose, y, X) for pose in poses), default=0.0))
    assert_draws(errors, below=1e-6, fraction=0.99)
    assert_draws(residuals, below=1e-6)


def p3p_residual(pose: Rigid3, y: np.ndarray, X: np.ndarray) -> float:
    """How far a pose is from the bearings, and from a rotation."""
    points_in_cam = pose.apply(X)
    off = np.abs(points_in_cam / np.linalg.norm(points_in_cam, axis=1, keepdims=True) - y).max()
    return float(max(off, np.abs(pose.R @ pose.R.T - np.eye(3)).max()))


def test_p3p_without_a_triangle_has_no_solution():
    y = bearings(np.array([[0.1, 0.2], [-0.3, 0.1], [0.2, -0.2]]))
    line = np.array([[0.0, 0, 4], [1.0, 0, 4], [2.0, 0, 4]])
    assert p3p(y, np.ones((3, 3))) == []
    assert p3p(y, np.zeros((3, 3))) == []
    assert all(np.isfinite(pose.R).all() for pose in p3p(y, line))
    assert p3p(bearings(line[:, :2] / 4), line) == []


def five_point_draw(kind: str, rng: np.random.Generator) -> tuple[Rigid3, np.ndarray, np.ndarray]:
    """cam2_from_cam1 with |t| = 1 and bearings in both cameras."""
    t = rng.normal(size=3)
    rotation = 1e-3 if kind == "near identity" else 0.4
    cam2_from_cam1 = Rigid3(exp(rotation * rng.normal(size=3)), t / np.linalg.norm(t))
    if kind == "forward":
        cam2_from_cam1 = Rigid3(cam2_from_cam1.R, np.array([0.0, 0.0, -1.0]))
    uv = rng.uniform(-1, 1, size=(5, 2))
    depths = rng.uniform(2, 8, size=5)
    if kind == "planar":
        depths = 4.0 / (1.0 + uv @ rng.uniform(-0.5, 0.5, size=2))
    X = bearings(uv) * depths[:, None]
    moved = cam2_from_cam1.apply(X)
    return cam2_from_cam1, bearings(uv), moved / np.linalg.norm(moved, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", ["general", "planar", "near identity", "forward"])
def test_five_point_recovers_exact_essential_matrices(kind):
    rng = np.random.default_rng(1)
    errors, residuals = [], []
    for _ in range(DRAWS):
        truth, x1, x2 = five_point_draw(kind, rng)
        E = essential_from_pose(truth)
        found = five_point(x1, x2)
        errors.append(min((min(np.abs(M - E).max(), np.abs(M + E).max()) for M in found), default=np.inf))
        residuals.append(max((epipolar_residual(M, x1, x2) for M in found), default=0.0))
    assert_draws(errors, below=1e-6, fraction=0.99)
    assert_draws(residuals, below=1e-9)


def epipolar_residual(M: np.ndarray, x1: np.ndarray, x2: np.ndarray) -> float:
    """Largest |x2^T M x1|."""
    return float(np.abs(np.sum(x2 * (x1 @ M.T), axis=1)).max())


def test_five_point_on_degenerate_input_is_finite():
    rng = np.random.default_rng(2)
    x = bearings(rng.uniform(-1, 1, size=(5, 2)))
    same = np.repeat(x[:1], 5, axis=0)
    for x1, x2 in [(x, x), (same, same), (x, x @ exp(np.array([0.1, 0.2, 0.3])).T)]:
        assert all(np.isfinite(E).all() for E in five_point(x1, x2))


@pytest.mark.parametrize("degree", [1, 2, 3, 7, 10])
def test_real_roots_are_those_of_the_companion_matrix(degree):
    rng = np.random.default_rng(degree)
    roots, chain = np.empty(16), np.empty((12, 13))
    errors = []
    for _ in range(200):
        c = rng.normal(size=degree + 1)
        count = real_roots_numba(c, degree, chain, roots)
        expected = np.roots(c[::-1])
        expected = np.sort(expected[np.abs(expected.imag) < 1e-10].real)
        if count == len(expected):
            off = np.abs(np.sort(roots[:count]) - expected) / (1.0 + np.abs(expected))
            errors.append(float(off.max(initial=0.0)))
        else:
            errors.append(np.inf)
    assert_draws(errors, below=1e-9)


def test_real_roots_of_chosen_polynomials():
    roots, chain = np.empty(16), np.empty((12, 13))
    wide = np.poly([-1e4, -1e-3, 0.0, 2.0, 5e3])[::-1].copy()
    count = real_roots_numba(wide, 5, chain, roots)
    np.testing.assert_allclose(np.sort(roots[:count]), [-1e4, -1e-3, 0.0, 2.0, 5e3], rtol=1e-6, atol=1e-9)
    assert real_roots_numba(np.array([1.0, 0.0, 1.0]), 2, chain, roots) == 0
    assert real_roots_numba(np.array([3.0, 0.0, 0.0]), 2, chain, roots) == 0
    assert real_roots_of_quadratic(2.0, -3.0, 1.0)[0] == 2
    assert sorted(real_roots_of_quadratic(2.0, -3.0, 1.0)[1:]) == pytest.approx([1.0, 2.0])
    assert real_roots_of_quadratic(1.0, 0.0, 1.0)[0] == 0
    assert real_roots_of_quadratic(4.0, -2.0, 0.0)[:2] == (1, 2.0)


def test_cubic_roots_have_no_residual():
    rng = np.random.default_rng(3)
    counts, errors = [], []
    for _ in range(500):
        c = rng.normal(size=4)
        count, *roots = real_roots_of_cubic(*c)
        counts.append(count)
        sizes = [np.abs(c) @ np.abs(x) ** np.arange(4) for x in roots[:count]]
        errors.append(max(abs(np.polyval(c[::-1], x)) / size for x, size in zip(roots, sizes, strict=False)))
    assert set(counts) == {1, 3}
    assert_draws(errors, below=1e-12)


@pytest.mark.parametrize("shape", [(9, 5), (9, 7), (9, 8), (4, 1)])
def test_null_space_is_orthonormal_and_null(shape):
    rng = np.random.default_rng(4)
    A = rng.normal(size=shape)
    N = np.empty((shape[0], shape[0] - shape[1]))
    null_space_numba(A.copy(), N)
    np.testing.assert_allclose(A.T @ N, 0, atol=1e-12)
    np.testing.assert_allclose(N.T @ N, np.eye(N.shape[1]), atol=1e-12)


def plane_z1(rays: np.ndarray) -> np.ndarray:
    return rays / rays[:, 2:]


def up_to_sign(found: np.ndarray, expected: np.ndarray) -> float:
    expected = expected / np.linalg.norm(expected)
    return float(min(np.abs(found - expected).max(), np.abs(found + expected).max()))


@pytest.mark.parametrize("kind", ["general", "near identity", "forward"])
def test_seven_point_recovers_exact_fundamental_matrices(kind):
    rng = np.random.default_rng(5)
    errors, counts, residuals = [], [], []
    for _ in range(DRAWS):
        truth, x1, _ = five_point_draw(kind, rng)
        points = np.concatenate([x1, bearings(rng.uniform(-1, 1, size=(2, 2)))]) * rng.uniform(2, 8, size=(7, 1))
        x1, x2 = plane_z1(points), plane_z1(truth.apply(points))
        found = seven_point(x1, x2)
        counts.append(len(found))
        errors.append(min((up_to_sign(F, essential_from_pose(truth)) for F in found), default=np.inf))
        off = [max(epipolar_residual(F, x1, x2), abs(float(np.linalg.det(F)))) for F in found]
        residuals.append(max(off, default=0.0))
    assert set(counts) <= {1, 2, 3}
    assert_draws(errors, below=1e-6, fraction=0.99)
    assert_draws(residuals, below=1e-9)


def test_homography_recovers_exact_planes():
    rng = np.random.default_rng(6)
    errors, missed = [], []
    for _ in range(DRAWS):
        x1 = np.concatenate([rng.uniform(-1, 1, size=(4, 2)), np.ones((4, 1))], axis=1)
        H = exp(0.3 * rng.normal(size=3)) + 0.3 * rng.normal(size=3)[:, None] * rng.normal(size=3) / 3
        moved = x1 @ H.T
        if np.linalg.det(H) <= 0 or np.any(moved[:, 2] <= 0.1):
            continue
        found = homography_four_point(x1, plane_z1(moved))
        behind = found is None or bool(np.any(x1 @ found.T[:, 2] <= 0))
        missed.append(float(behind))
        errors.append(np.inf if found is None else up_to_sign(found, H))
    assert len(errors) > DRAWS / 2
    assert_draws(missed, below=0.5)
    assert_draws(errors, below=1e-6, fraction=0.99)


def test_homography_needs_four_points_in_general_position():
    square = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    line = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1], [0, 1, 1]])
    folded = square[[0, 1, 3, 2]] * [1, 1, 1]
    assert homography_four_point(line, square) is None
    assert homography_four_point(square, line) is None
    assert homography_four_point(square, folded) is None
    assert homography_four_point(square, square) is not None


def test_plane_and_parallax_gives_the_exact_fundamental_matrix():
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(DRAWS):
        truth, x1, x2 = five_point_draw("general", rng)
        n = rng.normal(size=3)
        H = truth.R + 0.2 * np.outer(truth.t, n)
        models = np.zeros((1, 12))
        count = plane_and_parallax_numba(plane_z1(x1)[:2].copy(), plane_z1(x2)[:2].copy(), H.ravel(), models)
        error = up_to_sign(models[0, :9].reshape(3, 3), essential_from_pose(truth))
        errors.append(error if count == 1 else np.inf)
    assert_draws(errors, below=1e-6, fraction=0.99)
    same = np.ones((2, 3))
    assert plane_and_parallax_numba(same, same + [1.0, 0, 0], np.eye(3).ravel(), np.zeros((1, 12))) == 0


def test_rank_two_is_that_of_the_singular_values():
    rng = np.random.default_rng(8)
    errors, singular, norms = [], [], []
    for _ in range(100):
        U, S, Vt = np.linalg.svd(rng.normal(size=(3, 3)))
        S[2] = 0.02 * S[1]
        F, e1, e2 = (U * S @ Vt).ravel(), np.empty(3), np.empty(3)
        set_rank_two_numba(F, e1, e2)
        errors.append(up_to_sign(F.reshape(3, 3), U[:, :2] * S[:2] @ Vt[:2]))
        singular.append(float(np.linalg.svd(F.reshape(3, 3))[1][2]))
        norms.append(abs(float(np.linalg.norm(F)) - 1.0))
    assert_draws(errors, below=1e-3)
    assert_draws(singular, below=1e-12)
    assert_draws(norms, below=1e-7)
