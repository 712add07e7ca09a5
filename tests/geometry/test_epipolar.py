import numpy as np
import pytest

from fieldstone.geometry import epipolar
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp, random_rotation
from fieldstone.geometry.triangulation import (
    choose_by_cheirality,
    triangulate_linear,
    triangulate_midpoint,
    triangulate_tracks_linear,
    triangulation_angles,
)
from matchers import assert_rigid3_near

K1 = np.array([[800.0, 0, 400], [0, 820, 300], [0, 0, 1]])
K2 = np.array([[700.0, 0, 350], [0, 710, 260], [0, 0, 1]])


def two_views(seed: int, count: int = 30) -> tuple[Rigid3, np.ndarray, np.ndarray, np.ndarray]:
    """cam2_from_cam1 with |t| = 1, points in camera 1, and their ideal coordinates in both."""
    rng = np.random.default_rng(seed)
    t = rng.normal(size=3) * np.array([1, 1, 0.2])
    pose = Rigid3(exp(0.1 * rng.normal(size=3)), t / np.linalg.norm(t))
    points = np.concatenate([rng.uniform(-2, 2, size=(count, 2)), rng.uniform(4, 9, size=(count, 1))], axis=1)
    moved = pose.apply(points)
    return pose, points, points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("seed", range(20))
def test_pose_survives_the_essential_matrix_and_cheirality(seed):
    pose, points, uv1, uv2 = two_views(seed)
    E = epipolar.essential_from_pose(pose)
    F = epipolar.fundamental_from_essential(E, K1, K2)
    x1, x2 = epipolar.homogeneous(uv1) @ K1.T, epipolar.homogeneous(uv2) @ K2.T
    np.testing.assert_allclose(epipolar.sampson_error(F, x1, x2), 0.0, atol=1e-18)
    E_again = epipolar.essential_from_fundamental(F, K1, K2)
    np.testing.assert_allclose(np.linalg.svd(E_again, compute_uv=False), [1, 1, 0], atol=1e-12)
    candidates = epipolar.poses_from_essential(E_again)
    best, counts = choose_by_cheirality(candidates, uv1, uv2)
    assert sorted(counts)[:3] < [len(points)] * 3
    assert counts[best] == len(points)
    assert_rigid3_near(candidates[best], pose, angle=1e-9, distance=1e-9)


def test_four_poses_are_proper_and_solve_the_equation():
    for seed in range(20):
        E = epipolar.essential_from_pose(two_views(seed)[0])
        for candidate in epipolar.poses_from_essential(-E if seed % 2 else E):
            np.testing.assert_allclose(np.linalg.det(candidate.R), 1.0, atol=1e-12)
            E_candidate = epipolar.essential_from_pose(candidate)
            same_up_to_sign = min(np.abs(E_candidate - E).max(), np.abs(E_candidate + E).max())
            assert same_up_to_sign < 1e-12


def test_sampson_error_is_the_squared_distance_to_first_order():
    pose, _, uv1, uv2 = two_views(3)
    E = epipolar.essential_from_pose(pose)
    rng = np.random.default_rng(0)
    a = epipolar.homogeneous(uv1 + 1e-5 * rng.normal(size=uv1.shape))
    b = epipolar.homogeneous(uv2 + 1e-5 * rng.normal(size=uv2.shape))
    # Oracle: the exact distance to the constraint set, by Newton steps on the constraint from the noisy match.
    x = np.concatenate([a[:, :2], b[:, :2]], axis=1)
    start = x.copy()
    for _ in range(10):
        p, q = epipolar.homogeneous(x[:, :2]), epipolar.homogeneous(x[:, 2:])
        gradient = np.concatenate([(q @ E)[:, :2], (p @ E.T)[:, :2]], axis=1)
        c = np.sum(q * (p @ E.T), axis=1) + np.sum(gradient * (start - x), axis=1)
        x = start - gradient * (c / np.sum(gradient**2, axis=1))[:, None]
    np.testing.assert_allclose(epipolar.sampson_error(E, a, b), np.sum((x - start) ** 2, axis=1), rtol=1e-3)
    behind = a * np.array([1, 1, -1.0])
    assert np.all(np.isinf(epipolar.sampson_error(E, behind, b)))


def test_epipolar_lines_pass_through_the_matches():
    pose, _, uv1, uv2 = two_views(5)
    F = epipolar.fundamental_from_essential(epipolar.essential_from_pose(pose), K1, K2)
    pixels1, pixels2 = (epipolar.homogeneous(uv) @ K.T for uv, K in ((uv1, K1), (uv2, K2)))
    lines = epipolar.epipolar_lines(F, pixels1[:, :2])
    np.testing.assert_allclose(np.sum(lines * pixels2, axis=1), 0.0, atol=1e-8)
    shifted = pixels2[:, :2] + 3.0 * lines[:, :2]
    distance = epipolar.symmetric_epipolar_distance(F, pixels1[:, :2], shifted)
    assert np.all((distance > 1.0) & (distance < 30.0))


@pytest.mark.parametrize("num_views", [2, 3, 7])
def test_triangulation_recovers_points_from_any_number_of_views(num_views):
    rng = np.random.default_rng(num_views)
    points = rng.uniform(-1, 1, size=(40, 3))
    R = random_rotation(num_views, rng)
    poses = Rigid3(R, np.stack([-r @ c + 0 for r, c in zip(R, -8 * R[:, 2], strict=True)]))
    in_cam = np.einsum("vij,pj->pvi", poses.R, points) + poses.t
    uv = in_cam[..., :2] / in_cam[..., 2:]
    np.testing.assert_allclose(triangulate_linear(poses, uv), points, atol=1e-9)

    # Tracks of mixed lengths, shuffled: the first 10 points lose a view, one has a single view left.
    seen = np.ones((40, num_views), dtype=bool)
    seen[:10, -1] = num_views == 2
    seen[0, 1:] = False
    point, view = np.nonzero(seen)
    order = rng.permutation(len(point))
    found = triangulate_tracks_linear(poses, view[order], point[order], uv[point[order], view[order]], 40)
    assert np.all(np.isnan(found[0]))
    np.testing.assert_allclose(found[1:], points[1:], atol=1e-9)

    centers = poses.target_origin_in_source()
    directions = points[0] - centers
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(triangulate_midpoint(centers, directions), points[0], atol=1e-9)


def test_angles_at_a_right_triangle():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    angles = triangulation_angles(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), points)
    np.testing.assert_allclose(np.rad2deg(angles), [90.0, 90.0])
