from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.field.base.radiance_field import RenderedRays
from fieldstone.field.base.ray_dataset import SeenPoints
from fieldstone.field.evidence.pose_refinement import (
    RefinablePoses,
    refinable_poses,
    refined,
)
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.jacobian import image_from_world_jacobian
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.scene.photos import DecodedPhotos
from fieldstone.scene.rays import rays_from_view
from grid_scenes import FRAME, ball_photos, photographs, plan_of

CAMERA = Camera("SIMPLE_RADIAL", 96, 80, np.array([110.0, 48.0, 40.0, 0.02]))
WHITE = np.ones(3)
FREE, TIED = 1e-9 * np.eye(6), 1e12 * np.eye(6)


def textured_ball(rays):
    """An opaque ball of radius 1 at the origin with waves of colour on it."""
    b = np.sum(rays.origins * rays.directions, axis=1)
    discriminant = b**2 - np.sum(rays.origins**2, axis=1) + 1
    t = -b - np.sqrt(np.maximum(discriminant, 0))
    hit = discriminant > 0
    normals = rays.origins + t[:, None] * rays.directions
    waves = 0.5 + 0.3 * np.sin(7.0 * normals[:, [1, 2, 0]]) * np.cos(5.0 * normals)
    rgb = np.where(hit[:, None], waves, 1.0)
    return RenderedRays(rgb.astype(np.float32), np.where(hit, t, 9.0).astype(np.float32), hit.astype(np.float32))


def photo_from(pose: Rigid3) -> np.ndarray:
    rendered = textured_ball(rays_from_view(CAMERA, pose))
    return np.rint(255 * rendered.rgb).astype(np.uint8).reshape(CAMERA.height, CAMERA.width, 3)


def displaced(n: int, size: float) -> tuple[list[Rigid3], DecodedPhotos]:
    """True poses, and photos taken there that are said to be elsewhere."""
    rng = np.random.default_rng(2)
    true, said = [], []
    for k in range(n):
        angle = 2 * np.pi * k / n
        pose = look_at(np.array([3.5 * np.cos(angle), 3.5 * np.sin(angle), 0.7]), np.zeros(3), np.array([0.0, 0, 1]))
        true.append(pose)
        said.append(pose.retract(size * rng.normal(size=6)))
    return true, photographs(CAMERA, said, [photo_from(pose) for pose in true])


def errors(true: list[Rigid3], poses: Rigid3) -> np.ndarray:
    """Largest displacement of the corners of a cube in pixels, photo by photo."""
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    found = [image_from_cam(CAMERA, pose.apply(corners)) for pose in poses]
    expected = [image_from_cam(CAMERA, pose.apply(corners)) for pose in true]
    return np.array([np.linalg.norm(a - b, axis=1).max() for a, b in zip(found, expected, strict=True)])


def test_photos_find_back_to_where_they_were_taken():
    true, photos = displaced(4, 0.02)
    poses = photos.posed.cam_from_world
    before = errors(true, poses)
    assert before.min() > 0.9
    refinable = RefinablePoses(photos, np.stack([FREE] * 4))
    pose_deltas = np.zeros((4, 6))
    for _ in range(4):
        pose_deltas = refined(refinable, pose_deltas, textured_ball, np.ones((4, 3)), WHITE)
    after = errors(true, photos.posed.cam_from_world.retract(pose_deltas))
    assert after.max() < 0.02


def test_a_photo_twice_as_bright_finds_back_with_its_gain():
    true, photos = displaced(2, 0.02)
    dark = replace(photos, pixels=tuple(np.rint(0.5 * pixels).astype(np.uint8) for pixels in photos.pixels))
    refinable = RefinablePoses(dark, np.stack([FREE] * 2))
    pose_deltas = np.zeros((2, 6))
    for _ in range(4):
        pose_deltas = refined(refinable, pose_deltas, textured_ball, np.full((2, 3), 0.5), WHITE)
    assert errors(true, photos.posed.cam_from_world.retract(pose_deltas)).max() < 0.05


def test_known_points_hold_the_poses():
    _, photos = displaced(2, 0.004)
    pose_deltas = refined(
        RefinablePoses(photos, np.stack([TIED] * 2)), np.zeros((2, 6)), textured_ball, np.ones((2, 3)), WHITE
    )
    assert np.abs(pose_deltas).max() < 1e-7


def test_what_holds_a_photo_is_what_its_points_say():
    _, photos = displaced(2, 0.0)
    points = np.random.default_rng(1).uniform(-0.7, 0.7, size=(50, 3))
    held, by_cube = refinable_poses(photos, FRAME, [SeenPoints(points, np.full(50, 0.1)), None]).information
    # Half a pixel for each of 50 points: a motion that moves them by one pixel each costs 50 * 4 / 2.
    J = image_from_world_jacobian(CAMERA, photos.posed.pose_of(0), points).by_pose.reshape(100, 6)
    np.testing.assert_allclose(held, 4.0 * J.T @ J, rtol=1e-9)
    assert np.linalg.eigvalsh(by_cube).min() > 0


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_a_field_that_shows_nothing_moves_nothing(background):
    _, photos = displaced(1, 0.004)

    def nothing(rays):
        n = len(rays)
        return RenderedRays(np.full((n, 3), background, np.float32), np.ones(n, np.float32), np.zeros(n, np.float32))

    pose_deltas = refined(RefinablePoses(photos, FREE[None]), np.zeros((1, 6)), nothing, np.ones((1, 3)), WHITE)
    np.testing.assert_array_equal(pose_deltas, 0.0)


def test_training_moves_photos_and_goes_on_from_a_checkpoint_to_the_same_bytes():
    photos = ball_photos()
    tangents = np.zeros((len(photos), 6))
    tangents[2] = [0.0, 0.02, 0.0, 0.0, 0.0, 0.02]
    photos = replace(photos, posed=replace(photos.posed, cam_from_world=photos.posed.cam_from_world.retract(tangents)))
    plan = plan_of(
        finest=24, steps=(10, 15, 15, 15, 10, 5, 5, 5), num_chunks=2, samples_per_chunk=512, refine_poses=True
    )
    with ThreadPoolExecutor(2) as executor:
        training = prepare_grid_training(photos, FRAME, plan, seed=3, executor=executor, refine_poses=True)
        state, stopped = training.start(), None
        for step in range(plan.schedule.total_steps):
            if step == 45:
                stopped = {name: array.copy() for name, array in training.to_tensors(state).items()}
            state, _ = training.advance(state)
        assert stopped is not None
        again = training.from_tensors(stopped)
        for _ in range(45, plan.schedule.total_steps):
            again, _ = training.advance(again)
        assert np.abs(state.pose_deltas).max() > 0.0
        assert not np.array_equal(state.rays.centers, training.rays.centers)
        one, other = training.to_tensors(state), training.to_tensors(again)
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name], err_msg=name)


def test_rays_to_known_points_move_with_their_photos():
    photos, seen = ball_photos(3), []
    for towards in photos.posed.centers():
        p = np.random.default_rng(0).normal(size=(60, 3)) * 0.2 + towards / np.linalg.norm(towards)
        seen.append(SeenPoints(0.8 * p / np.linalg.norm(p, axis=1, keepdims=True), np.full(60, 0.01)))
    plan = plan_of(finest=24, steps=(2,) * 8, num_chunks=2, samples_per_chunk=512, box_warm_up=False, refine_poses=True)
    with ThreadPoolExecutor(1) as executor:
        work = prepare_grid_training(photos, FRAME, plan, seed=0, executor=executor, seen=seen, refine_poses=True)
        saved = {name: array.copy() for name, array in work.to_tensors(work.start()).items()}
        saved["moved"][1] = [0.0, 0.02, 0.0, 0.1, 0.0, 0.0]
        state = work.from_tensors(saved)
    assert len(state.depth_rays.image) > 0
    np.testing.assert_array_equal(state.depth_rays.centers, state.rays.centers)
    np.testing.assert_array_equal(state.depth_rays.rotations, state.rays.rotations)
    pose_deltas = photos.posed.pose_of(1).retract(saved["moved"][1]).target_origin_in_source()
    np.testing.assert_allclose(state.depth_rays.centers[1], pose_deltas, atol=1e-6)


def test_a_lens_with_pixels_that_no_ray_reaches_is_compared_where_it_shows_something():
    lens = Camera("OPENCV_FISHEYE", 64, 64, np.array([18.0, 18.0, 32.0, 32.0, -0.3, 0.0, 0.0, 0.0]))
    pose = ball_photos(1).posed.pose_of(0)
    wide = photographs(lens, [pose], [np.full((64, 64, 3), 200, np.uint8)])
    rays = rays_from_view(lens, pose)
    assert not np.isfinite(rays.directions).all()

    def finite_only(rays):
        assert np.isfinite(rays.directions).all()
        return textured_ball(rays)

    refinable = refinable_poses(wide, FRAME, ())
    assert np.isfinite(refined(refinable, np.zeros((1, 6)), finite_only, np.ones((1, 3)), WHITE)).all()
