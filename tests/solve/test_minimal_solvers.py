"""Minimal solvers on 1,000 exact draws each, against the equations they solve and the pose that made the data."""

import numpy as np
import pytest

from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp, random_rotation
from fieldstone.geometry.triangulation import bearings
from fieldstone.solve.five_point import five_point
from fieldstone.solve.null_space_numba import null_space_numba
from fieldstone.solve.p3p import p3p
from fieldstone.solve.polynomial_roots import real_roots_numba, real_roots_of_cubic, real_roots_of_quadratic

DRAWS = 1000


def nearest_pose_error(poses: list[Rigid3], truth: Rigid3) -> float:
    return min(
        (max(float(angle_between(p.R, truth.R)), float(np.linalg.norm(p.t - truth.t))) for p in poses), default=np.inf
    )


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
    errors = []
    for _ in range(DRAWS):
        truth, y, X = p3p_draw(kind, rng)
        poses = p3p(y, X)
        errors.append(nearest_pose_error(poses, truth))
        for pose in poses:
            points_in_cam = pose.apply(X)
            length = np.linalg.norm(points_in_cam, axis=1, keepdims=True)
            np.testing.assert_allclose(points_in_cam / length, y, atol=1e-6)
            np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-6)
    assert np.mean(np.array(errors) < 1e-6) >= 0.99


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
    errors = []
    for _ in range(DRAWS):
        truth, x1, x2 = five_point_draw(kind, rng)
        E = essential_from_pose(truth)
        found = five_point(x1, x2)
        errors.append(min((min(np.abs(M - E).max(), np.abs(M + E).max()) for M in found), default=np.inf))
        for M in found:
            np.testing.assert_allclose(np.sum(x2 * (x1 @ M.T), axis=1), 0, atol=1e-9)
    assert np.mean(np.array(errors) < 1e-6) >= 0.99


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
    for _ in range(200):
        c = rng.normal(size=degree + 1)
        count = real_roots_numba(c, degree, chain, roots)
        expected = np.roots(c[::-1])
        expected = np.sort(expected[np.abs(expected.imag) < 1e-10].real)
        assert count == len(expected)
        np.testing.assert_allclose(np.sort(roots[:count]), expected, rtol=1e-9, atol=1e-9)


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
    for _ in range(500):
        c = rng.normal(size=4)
        count, *roots = real_roots_of_cubic(*c)
        assert count in (1, 3)
        for x in roots[:count]:
            size = np.abs(c) @ np.abs(x) ** np.arange(4)
            assert abs(np.polyval(c[::-1], x)) < 1e-12 * size


@pytest.mark.parametrize("shape", [(9, 5), (9, 7), (9, 8), (4, 1)])
def test_null_space_is_orthonormal_and_null(shape):
    rng = np.random.default_rng(4)
    A = rng.normal(size=shape)
    N = np.empty((shape[0], shape[0] - shape[1]))
    null_space_numba(A.copy(), N)
    np.testing.assert_allclose(A.T @ N, 0, atol=1e-12)
    np.testing.assert_allclose(N.T @ N, np.eye(N.shape[1]), atol=1e-12)
