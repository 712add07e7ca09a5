import numpy as np
import pytest

from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.solve.minimal.eight_point import fundamental_eight_point
from fieldstone.solve.robust.focal_voting import focal_cost, vote_focal, vote_focal_of_rotations


def pairs(focal: float, count: int, noise: float, seed: int = 0) -> np.ndarray:
    """Fundamental matrices of random pairs, from exact geometry or from noisy matches; unit: the longer side."""
    rng = np.random.default_rng(seed)
    K_inv = np.diag([1 / focal, 1 / focal, 1.0])
    out = []
    for _ in range(count):
        t = rng.normal(size=3)
        pose = Rigid3(exp(0.25 * rng.normal(size=3)), t / np.linalg.norm(t))
        F = K_inv @ essential_from_pose(pose) @ K_inv
        if noise:
            points = rng.uniform([-2, -2, 4], [2, 2, 9], size=(200, 3))
            other = pose.apply(points)
            x1, x2 = (focal * p[:, :2] / p[:, 2:] + noise * rng.normal(size=(200, 2)) for p in (points, other))
            F = fundamental_eight_point(x1, x2)
        out.append(F / np.linalg.norm(F))
    return np.array(out)


@pytest.mark.parametrize("focal", [0.5, 0.9, 2.7])
def test_exact_pairs_give_the_focal_length(focal):
    vote = vote_focal(pairs(focal, 20, 0.0), np.ones(20))
    assert abs(vote.ratio / focal - 1) < 0.01
    assert vote.contrast > 0.9
    assert focal_cost(pairs(focal, 20, 0.0), np.ones(20), focal) < 1e-9


@pytest.mark.parametrize("focal", [0.7, 1.5])
def test_noisy_pairs_with_false_ones_still_agree(focal):
    fundamentals = pairs(focal, 40, 0.5 / 1600, seed=1)
    fundamentals[:12] = np.random.default_rng(2).normal(size=(12, 3, 3))
    assert abs(vote_focal(fundamentals, np.ones(40)).ratio / focal - 1) < 0.05


def test_no_pair_is_refused():
    with pytest.raises(ValueError, match="without pairs"):
        vote_focal(np.empty((0, 3, 3)), np.empty(0))


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
    vote = vote_focal_of_rotations(turns(focal, 15, 1e-3), np.ones(15))
    assert vote is not None
    assert abs(vote.ratio / focal - 1) < 0.02
    assert vote.contrast > 0.5


def test_a_plane_seen_from_several_places_is_no_turning_camera():
    assert vote_focal_of_rotations(turns(1.0, 15, 0.0, shift=0.3), np.ones(15)) is None
    assert vote_focal_of_rotations(np.empty((0, 3, 3)), np.empty(0)) is None


def test_copies_of_one_photo_tell_no_focal_length():
    noise = 1e-5 * np.random.default_rng(0).normal(size=(10, 3, 3))
    assert vote_focal_of_rotations(np.eye(3) + noise, np.ones(10)) is None
