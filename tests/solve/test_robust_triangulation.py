import numpy as np

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.solve.robust.triangulation import triangulate_robust

FOCAL = 1000.0


def tracks(seed: int, num_views: int = 6, num_points: int = 300):
    """Cameras on a line looking ahead, every point in every view, ideal coordinates."""
    rng = np.random.default_rng(seed)
    R = exp(0.05 * rng.normal(size=(num_views, 3)))
    centers = np.stack([np.linspace(-1, 1, num_views), np.zeros(num_views), np.zeros(num_views)], axis=1)
    poses = Rigid3(R, -np.einsum("vij,vj->vi", R, centers))
    points = rng.uniform([-2, -2, 4], [2, 2, 10], size=(num_points, 3))
    view = np.tile(np.arange(num_views), num_points)
    in_cam = poses[view].apply(np.repeat(points, num_views, axis=0))
    starts = np.arange(0, num_views * num_points + 1, num_views)
    return poses, points, view, in_cam[:, :2] / in_cam[:, 2:], starts


def solve(poses, view, uv, starts, max_error_px=4.0, min_angle_deg=1.5):
    focal = np.full(len(poses.t), FOCAL)
    return triangulate_robust(
        poses, focal, view, uv, starts, max_error_px=max_error_px, min_angle=np.deg2rad(min_angle_deg)
    )


def test_exact_tracks_are_recovered():
    poses, points, view, uv, starts = tracks(0)
    xyz, inliers = solve(poses, view, uv, starts)
    np.testing.assert_allclose(xyz, points, atol=1e-9)
    assert inliers.all()


def test_false_observations_lose_the_vote():
    poses, points, view, uv, starts = tracks(1)
    rng = np.random.default_rng(2)
    false = np.zeros(len(view), dtype=bool)
    for start in starts[:-1]:
        false[start + rng.choice(6, 2, replace=False)] = True
    uv = uv + (0.3 / FOCAL) * rng.normal(size=uv.shape)
    uv[false] += 0.05 * np.where(rng.random((false.sum(), 2)) < 0.5, -1, 1) * rng.uniform(1, 2, (false.sum(), 2))
    xyz, inliers = solve(poses, view, uv, starts)
    solved = np.isfinite(xyz[:, 0])
    assert solved.mean() > 0.99
    assert inliers[false].mean() < 0.02
    assert inliers[~false].mean() > 0.97
    # Depth error of noise s px at depth z over baseline b is about s z^2 / (f b).
    depth_sigma = 0.3 * points[:, 2] ** 2 / FOCAL
    close = np.linalg.norm(xyz - points, axis=1) < 6 * depth_sigma
    assert close[solved].mean() > 0.97


def test_refined_points_minimise_the_squared_error():
    poses, _, view, uv, starts = tracks(3, num_points=50)
    uv = uv + (0.5 / FOCAL) * np.random.default_rng(4).normal(size=uv.shape)
    xyz, inliers = solve(poses, view, uv, starts, max_error_px=20.0)
    assert inliers.all()
    point = np.repeat(np.arange(50), 6)

    def cost(X):
        in_cam = poses[view].apply(X[point])
        return np.bincount(point, np.sum((in_cam[:, :2] / in_cam[:, 2:] - uv) ** 2, axis=1)) * FOCAL**2

    rng = np.random.default_rng(5)
    for _ in range(30):
        assert np.all(cost(xyz + 1e-3 * rng.normal(size=xyz.shape)) > cost(xyz) - 1e-4)


def test_parallel_rays_points_behind_and_short_tracks_give_nothing():
    poses, _, view, uv, starts = tracks(6, num_points=3)
    xyz, inliers = solve(poses, view, uv, starts, min_angle_deg=60.0)
    assert np.all(np.isnan(xyz))
    assert not inliers.any()
    mirrored = Rigid3(poses.R, -poses.t)  # the baseline reversed: rays meet behind the cameras
    assert np.all(np.isnan(solve(mirrored, view, uv, starts)[0]))
    xyz, inliers = solve(poses, view[:1], uv[:1], np.array([0, 1, 1]))
    assert np.all(np.isnan(xyz))
    assert not inliers.any()
