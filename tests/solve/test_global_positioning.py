import numpy as np
import pytest

from fieldstone.geometry.sim3 import fit_sim3
from fieldstone.solve.averaging.positions import position_views_and_points


def observed(centers: np.ndarray, points: np.ndarray, share: float, rng: np.random.Generator):
    """Rays of a random part of all observations; every view and point keeps at least three."""
    seen = rng.random((len(centers), len(points))) < share
    seen[:3] = True
    seen[:, :3] = True
    view, point = np.nonzero(seen)
    rays = points[point] - centers[view]
    return view, point, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def error(found: np.ndarray, truth: np.ndarray) -> float:
    size = np.linalg.norm(truth - truth.mean(axis=0), axis=1).max()
    return float(np.linalg.norm(fit_sim3(found, truth).apply(found) - truth, axis=1).max() / size)


@pytest.mark.parametrize("layout", ["scattered", "line"])
def test_exact_rays_give_exact_positions(layout):
    """On a line the directions between cameras say nothing of their distances: the points must."""
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(20, 3)) * (3.0 if layout == "scattered" else np.array([3.0, 0.0, 0.0]))
    points = rng.normal(size=(80, 3)) + [0.0, 0.0, 12.0]
    found, found_points = position_views_and_points(*observed(centers, points, 0.4, rng))
    assert error(np.concatenate([found, found_points]), np.concatenate([centers, points])) < 1e-5
    assert np.linalg.norm(found[0]) == 0.0
    assert np.linalg.norm(found, axis=1).max() == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_false_rays_move_little(seed):
    rng = np.random.default_rng(seed)
    centers, points = rng.normal(size=(30, 3)) * 3.0, rng.normal(size=(300, 3)) + [0.0, 0.0, 12.0]
    view, point, rays = observed(centers, points, 0.3, rng)
    rays += rng.normal(scale=1e-3, size=rays.shape)
    false = rng.random(len(rays)) < 0.1
    rays[false] += rng.normal(scale=0.3, size=(int(false.sum()), 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found, _ = position_views_and_points(view, point, rays)
    assert error(found, centers) < 0.01
