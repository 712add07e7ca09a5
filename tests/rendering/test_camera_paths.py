import numpy as np
import pytest

from fieldstone.geometry import rotation
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.rendering.camera_paths import focus_point, orbit, spiral, through, up_direction
from matchers import assert_rigid3_near

FOCUS = np.array([0.5, -1.0, 2.0])
UP = np.array([0.0, 0.6, 0.8])


def ring(azimuths_deg, radius=4.0, height=1.5):
    """Cameras on a circle about the axis FOCUS + s UP that look at FOCUS."""
    east = np.array([1.0, 0.0, 0.0])
    north = np.cross(UP, east)
    a = np.deg2rad(azimuths_deg)
    centers = FOCUS + radius * (np.cos(a)[:, None] * east + np.sin(a)[:, None] * north) + height * UP
    return Rigid3.stack([look_at(c, FOCUS, UP) for c in centers])


def test_focus_point_is_where_the_axes_meet():
    np.testing.assert_allclose(focus_point(ring(np.array([0.0, 50, 170]))), FOCUS, atol=1e-5)


def test_focus_point_of_parallel_cameras_lies_in_front():
    poses = Rigid3.stack([Rigid3(np.eye(3), -np.array([x, 0.0, 0.0])) for x in (-1.0, 0.0, 1.0)])
    point = focus_point(poses)
    assert point[2] > 0.1
    np.testing.assert_allclose(point[:2], 0.0, atol=1e-9)


def test_orbit_of_a_ring_is_that_ring():
    poses = ring(np.arange(0.0, 360.0, 30.0))
    path = orbit(poses, 24)
    centers = path.target_origin_in_source()
    np.testing.assert_allclose(up_direction(poses), UP, atol=1e-9)
    np.testing.assert_allclose(up_direction(poses[:3]), UP, atol=2e-3)
    np.testing.assert_allclose((centers - FOCUS) @ UP, 1.5, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(centers - FOCUS, axis=1), np.hypot(4.0, 1.5), atol=1e-4)
    # Equal steps all around.
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    np.testing.assert_allclose(steps, 2 * 4.0 * np.sin(np.pi / 24), rtol=1e-4)
    for k in range(24):
        assert np.linalg.norm(path[k].apply(FOCUS[None])[0, :2]) < 1e-4


def test_orbit_of_an_arc_stays_on_the_arc():
    path = orbit(ring(np.array([-40.0, -10, 20, 50])), 40)
    offsets = path.target_origin_in_source() - FOCUS
    azimuth = np.rad2deg(np.arctan2(offsets @ np.cross(UP, [1.0, 0, 0]), offsets[:, 0]))
    assert azimuth.min() == pytest.approx(-40, abs=0.1)
    assert azimuth.max() == pytest.approx(50, abs=0.5)
    # To and fro: the film ends where it began.
    assert abs(azimuth[-1] - azimuth[0]) < 2


def test_spiral_looks_at_the_focus_and_closes():
    poses = ring(np.array([80.0, 90, 100]))
    path = spiral(poses, 60)
    for k in range(60):
        in_cam = path[k].apply(FOCUS[None])[0]
        assert np.linalg.norm(in_cam[:2]) < 1e-4
        assert in_cam[2] > 0
    centers = path.target_origin_in_source()
    steps = np.linalg.norm(np.roll(centers, -1, axis=0) - centers, axis=1)
    assert steps.max() < 3 * np.median(steps)


def test_path_through_poses_meets_each_of_them():
    rng = np.random.default_rng(0)
    poses = Rigid3.stack([Rigid3(rotation.exp(rng.standard_normal(3)), rng.standard_normal(3)) for _ in range(4)])
    path = through(poses, 31)
    for k in range(4):
        assert_rigid3_near(path[10 * k], poses[k], angle=1e-9, distance=1e-9)
    # Continuous: halving the steps halves the largest of them.
    fine = through(poses, 61)
    assert largest_turn(fine) == pytest.approx(largest_turn(path) / 2, rel=0.1)
    assert through(poses[:1], 3).R.shape == (3, 3, 3)


def largest_turn(path):
    return max(float(rotation.angle_between(path.R[k], path.R[k + 1])) for k in range(len(path.R) - 1))


def test_focus_point_of_diverging_cameras_lies_in_front():
    """A camera that is carried to the right turns to the right: the axes meet behind it."""
    poses = []
    for x in (-1.0, 0.0, 1.0):
        center = np.array([x, 0.0, 0.0])
        poses.append(look_at(center, center + np.array([0.3 * x, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])))
    assert focus_point(Rigid3.stack(poses))[2] > 0.1
