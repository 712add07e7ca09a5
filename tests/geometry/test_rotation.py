import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fieldstone.geometry import rotation
from matchers import check_jacobian

EDGE_VECTORS = np.array(
    [[0, 0, 0], [1e-12, 0, 0], [1e-5, -1e-5, 2e-5], [np.pi, 0, 0], [0, -np.pi + 1e-9, 0], [1.0, 2.0, -0.5]]
)


@pytest.fixture
def omega() -> np.ndarray:
    axes = np.random.default_rng(0).normal(size=(1000, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return axes * np.random.default_rng(1).uniform(0, np.pi, size=(1000, 1))


def test_exp_matches_scipy(omega):
    vectors = np.concatenate([omega, EDGE_VECTORS])
    np.testing.assert_allclose(rotation.exp(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)


def test_log_inverts_exp(omega):
    np.testing.assert_allclose(rotation.log(rotation.exp(omega)), omega, atol=1e-12)
    np.testing.assert_allclose(
        rotation.exp(rotation.log(rotation.exp(EDGE_VECTORS))), rotation.exp(EDGE_VECTORS), atol=1e-14
    )


def test_quaternions_match_scipy(omega):
    R = rotation.exp(omega)
    np.testing.assert_allclose(
        rotation.to_wxyz(R), Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True), atol=1e-12
    )
    np.testing.assert_allclose(rotation.from_wxyz(3.0 * rotation.to_wxyz(R)), R, atol=1e-14)
    with pytest.raises(ValueError, match="zero"):
        rotation.from_wxyz(np.zeros(4))


def test_nearest_rotation_is_the_closest_and_proper():
    rng = np.random.default_rng(2)
    M = rng.normal(size=(50, 3, 3))
    R = rotation.nearest_rotation(M)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    nearby = R[:, None] @ rotation.exp(0.1 * rng.normal(size=(50, 100, 3)))
    distance = np.linalg.norm(M - R, axis=(1, 2))
    assert np.all(np.linalg.norm(M[:, None] - nearby, axis=(2, 3)) >= distance[:, None])


def test_angle_between_is_accurate_at_both_ends():
    R = rotation.random_rotation(20, np.random.default_rng(3))
    for angle in (0.0, 1e-9, 1.0, np.pi - 1e-9):
        turned = R @ rotation.exp(np.array([0.6, 0.0, 0.8]) * angle)
        np.testing.assert_allclose(rotation.angle_between(R, turned), angle, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.0099, 0.0101, 1.0, 3.1, np.pi])
def test_right_jacobian_is_the_derivative_of_exp(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    inverse = rotation.exp(-vector)
    check_jacobian(lambda d: rotation.log(inverse @ rotation.exp(vector + d)), rotation.right_jacobian(vector), size=3)
