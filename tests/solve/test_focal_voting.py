import numpy as np
import pytest

from fieldstone.geometry.rotation import exp
from fieldstone.solve.robust.focal_voting import vote_focal_of_rotations


def turns(focal: float, count: int, noise: float, shift: float = 0.0) -> np.ndarray:
    """Homographies of a camera that turns; with `shift`, that also moves in front of a plane at distance 1."""
    rng = np.random.default_rng(3)
    K, K_inv = np.diag([focal, focal, 1.0]), np.diag([1 / focal, 1 / focal, 1.0])
    normal = np.array([0.0, 0.0, 1.0])
    H = [
        K @ (exp(0.2 * rng.normal(size=3)) + shift * np.outer(rng.normal(size=3), normal)) @ K_inv for _ in range(count)
    ]
    return np.array([h / np.linalg.norm(h) * (1 + noise * rng.normal(size=(3, 3))) for h in H])


@pytest.mark.parametrize("focal", [0.4, 1.0, 2.5])
def test_a_turning_camera_gives_the_focal_length(focal):
    voted = vote_focal_of_rotations(turns(focal, 15, 1e-3), np.ones(15))
    assert voted is not None
    assert abs(voted / focal - 1) < 0.02


def test_a_plane_seen_from_several_places_is_no_turning_camera():
    assert vote_focal_of_rotations(turns(1.0, 15, 0.0, shift=0.3), np.ones(15)) is None
    assert vote_focal_of_rotations(np.empty((0, 3, 3)), np.empty(0)) is None


def test_copies_of_one_photo_tell_no_focal_length():
    noise = 1e-5 * np.random.default_rng(0).normal(size=(10, 3, 3))
    assert vote_focal_of_rotations(np.eye(3) + noise, np.ones(10)) is None
