"""Posed cameras: where they look, foreign axes, and how pixels move with pose, point and parameters."""

from dataclasses import replace

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.jacobian import image_from_world_jacobian
from fieldstone.geometry.opengl import cam_from_world_of_gl
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.rotation import random_rotation
from matchers import assert_rigid3_near, check_jacobian

CAMERA = Camera("OPENCV", 640, 480, np.array([500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -1e-3]))
UP = np.array([0.0, 0.0, 1.0])


def test_look_at_puts_the_target_on_the_axis_and_up_above():
    center, target, up = np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.5, 1.0]), UP
    pose = look_at(center, target, up)
    np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.R) > 0
    np.testing.assert_allclose(pose.apply(target), [0, 0, float(np.linalg.norm(target - center))], atol=1e-12)
    above = pose.apply(target + 0.1 * up)
    assert above[1] < 0
    assert abs(above[0]) < 1e-12
    with pytest.raises(ValueError, match="no upright position"):
        look_at(center, center + up, up)
    np.testing.assert_allclose(pose.target_origin_in_source(), center, atol=1e-12)


@pytest.mark.parametrize("target", [UP, -UP, np.zeros(3)])
def test_look_at_straight_up_or_nowhere_has_no_upright_position(target):
    with pytest.raises(ValueError, match="no upright position"):
        look_at(np.zeros(3), target, UP)


def test_jacobians_of_pixels_match_central_differences():
    rng = np.random.default_rng(0)
    pose = look_at(np.array([3.0, 1.0, 0.5]), np.zeros(3), UP)
    points = rng.uniform(-0.6, 0.6, size=(20, 3))
    J = image_from_world_jacobian(CAMERA, pose, points)
    np.testing.assert_array_equal(J.pixels, image_from_cam(CAMERA, pose.apply(points)))
    check_jacobian(lambda d: image_from_cam(CAMERA, pose.retract(d).apply(points)), J.by_pose, size=6)
    check_jacobian(lambda d: image_from_cam(CAMERA, pose.apply(points + d)), J.by_point, size=3)
    moved = lambda d: image_from_cam(replace(CAMERA, params=CAMERA.params + d), pose.apply(points))  # noqa: E731
    check_jacobian(moved, J.by_params, size=8, rtol=1e-5)


def test_jacobian_is_nan_behind_the_camera_and_takes_a_pose_per_point():
    poses = Rigid3.stack([look_at(UP, c, np.array([0.0, 1.0, 0.0])) for c in np.diag([1.0, 0.3, -1.0])])
    points = np.array([[0.5, 0.1, 0.2], [0.0, 0.2, 0.1], [0.1, 0.0, 5.0]])
    J = image_from_world_jacobian(CAMERA, poses, points)
    for k in range(3):
        alone = image_from_world_jacobian(CAMERA, poses[k], points[k : k + 1])
        np.testing.assert_allclose(J.by_pose[k], alone.by_pose[0], rtol=1e-12)
    assert np.isnan(J.pixels[2]).all()
    assert np.isnan(J.by_pose[2]).all()


def test_opengl_cameras_look_along_minus_z_with_y_up():
    rng = np.random.default_rng(1)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = random_rotation(1, rng)[0], rng.normal(size=3)
    cam_from_world = cam_from_world_of_gl(matrix)
    in_gl = np.array([0.3, 0.2, -2.0, 1.0])  # right, up, in front
    np.testing.assert_allclose(cam_from_world.apply((matrix @ in_gl)[:3]), [0.3, -0.2, 2.0], atol=1e-12)
    assert_rigid3_near(cam_from_world_of_gl(np.diag([1.0, -1.0, -1.0, 1.0])), Rigid3.identity())


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "4x4"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
        (np.diag([1.0, 1.1, 1.0, 1.0]), "not orthonormal"),
        (np.diag([1e300, 1.0, 1.0, 1.0]), "not orthonormal"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
    ],
)
def test_matrices_that_are_no_rigid_motion_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        cam_from_world_of_gl(matrix)
