import numpy as np
import pytest

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp, random_rotation, skew
from fieldstone.geometry.sim3 import Sim3, fit_sim3
from matchers import assert_rigid3_near, check_jacobian


def random_rigid(count: int, seed: int) -> Rigid3:
    rng = np.random.default_rng(seed)
    return Rigid3(random_rotation(count, rng), rng.normal(size=(count, 3)))


def test_composition_and_inverse_follow_the_group_laws():
    a, b, c = (random_rigid(10, seed) for seed in range(3))
    points = np.random.default_rng(9).normal(size=(10, 3))
    assert_rigid3_near((a @ b) @ c, a @ (b @ c), angle=1e-12, distance=1e-12)
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)
    np.testing.assert_allclose((a @ a.inverse()).matrix(), np.broadcast_to(np.eye(4), (10, 4, 4)), atol=1e-12)
    np.testing.assert_allclose(a.apply(a.target_origin_in_source()), 0.0, atol=1e-12)


def test_retract_has_the_stated_derivative():
    pose, point = random_rigid(1, 4)[0], np.array([0.3, -1.0, 2.0])
    jacobian = np.concatenate([-pose.R @ skew(point), pose.R], axis=1)
    check_jacobian(lambda delta: pose.retract(delta).apply(point), jacobian, size=6)


def test_fit_sim3_recovers_a_similarity():
    rng = np.random.default_rng(5)
    for _ in range(100):
        truth = Sim3(float(rng.uniform(0.1, 10)), random_rotation(1, rng)[0], rng.normal(size=3))
        points = rng.normal(size=(3, 3))
        found = fit_sim3(points, truth.apply(points))
        np.testing.assert_allclose(found.scale, truth.scale, rtol=1e-9)
        np.testing.assert_allclose(found.R, truth.R, atol=1e-7)
        np.testing.assert_allclose(found.t, truth.t, atol=1e-6)


def test_fit_sim3_is_the_least_squares_minimum():
    rng = np.random.default_rng(6)
    a, b = rng.normal(size=(2, 20, 3))
    best = fit_sim3(a, b)
    cost = np.sum((best.apply(a) - b) ** 2)
    for _ in range(200):
        d = 1e-3 * rng.normal(size=7)
        other = Sim3(best.scale * (1 + d[0]), best.R @ exp(d[1:4]), best.t + d[4:])
        assert np.sum((other.apply(a) - b) ** 2) >= cost


def test_fit_sim3_never_mirrors_and_refuses_a_single_place():
    points = np.random.default_rng(7).normal(size=(10, 3))
    mirrored = fit_sim3(points, points * np.array([1, 1, -1]))
    np.testing.assert_allclose(np.linalg.det(mirrored.R), 1.0, atol=1e-12)
    with pytest.raises(ValueError, match="same"):
        fit_sim3(np.ones((4, 3)), points[:4])
    with pytest.raises(ValueError, match="at least 2"):
        fit_sim3(points[:1], points[:1])


def test_sim3_moves_a_pose_with_the_world():
    pose, points = random_rigid(1, 8)[0], np.random.default_rng(8).normal(size=(5, 3))
    b_from_a = Sim3(2.5, random_rotation(1, np.random.default_rng(10))[0], np.array([1.0, -2.0, 0.5]))
    moved = b_from_a.move_pose(pose)
    np.testing.assert_allclose(moved.apply(b_from_a.apply(points)), 2.5 * pose.apply(points), atol=1e-12)
    np.testing.assert_allclose((b_from_a @ b_from_a.inverse()).apply(points), points, atol=1e-12)
