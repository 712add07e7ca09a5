from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.field.base.radiance_field import RenderedRays
from fieldstone.field.base.ray_dataset import PosedImage, SeenPoints
from fieldstone.field.evidence.pose_refinement import (
    RefinablePhoto,
    refinable_photos,
    refined,
    refined_images,
)
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.jacobian import image_from_world_jacobian
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.scene.rays import rays_from_view
from grid_scenes import FRAME, ball_images, plan_of

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


def displaced(n: int, size: float) -> tuple[list[Rigid3], list[PosedImage]]:
    """True poses, and photos taken there that are said to be elsewhere."""
    rng = np.random.default_rng(2)
    true, images = [], []
    for k in range(n):
        angle = 2 * np.pi * k / n
        pose = look_at(np.array([3.5 * np.cos(angle), 3.5 * np.sin(angle), 0.7]), np.zeros(3), np.array([0.0, 0, 1]))
        true.append(pose)
        said = pose.retract(size * rng.normal(size=6))
        images.append(PosedImage(f"{k}", CAMERA, said, photo_from(pose)))
    return true, images


def errors(true: list[Rigid3], images) -> np.ndarray:
    """Largest displacement of the corners of a cube in pixels, photo by photo."""
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    found = [image_from_cam(CAMERA, image.cam_from_world.apply(corners)) for image in images]
    expected = [image_from_cam(CAMERA, pose.apply(corners)) for pose in true]
    return np.array([np.linalg.norm(a - b, axis=1).max() for a, b in zip(found, expected, strict=True)])


def test_photos_find_back_to_where_they_were_taken():
    true, images = displaced(4, 0.02)
    before = errors(true, images)
    assert before.min() > 0.9
    photos = [RefinablePhoto(image, FREE) for image in images]
    pose_deltas = np.zeros((4, 6))
    for _ in range(4):
        pose_deltas = refined(photos, pose_deltas, textured_ball, np.ones((4, 3)), WHITE)
    after = errors(true, refined_images(images, pose_deltas))
    assert after.max() < 0.02


def test_a_photo_twice_as_bright_finds_back_with_its_gain():
    true, images = displaced(2, 0.02)
    dark = [replace(image, pixels=np.rint(0.5 * image.pixels).astype(np.uint8)) for image in images]
    photos = [RefinablePhoto(image, FREE) for image in dark]
    pose_deltas = np.zeros((2, 6))
    for _ in range(4):
        pose_deltas = refined(photos, pose_deltas, textured_ball, np.full((2, 3), 0.5), WHITE)
    assert errors(true, refined_images(dark, pose_deltas)).max() < 0.05


def test_known_points_hold_the_poses():
    _, images = displaced(2, 0.004)
    photos = [RefinablePhoto(image, TIED) for image in images]
    pose_deltas = refined(photos, np.zeros((2, 6)), textured_ball, np.ones((2, 3)), WHITE)
    assert np.abs(pose_deltas).max() < 1e-7


def test_what_holds_a_photo_is_what_its_points_say():
    _, images = displaced(2, 0.0)
    points = np.random.default_rng(1).uniform(-0.7, 0.7, size=(50, 3))
    seen = {"0": SeenPoints(points, np.full(50, 0.1))}
    held, by_cube = refinable_photos(tuple(images), FRAME, seen)
    # Half a pixel for each of 50 points: a motion that moves them by one pixel each costs 50 * 4 / 2.
    J = image_from_world_jacobian(CAMERA, images[0].cam_from_world, points).by_pose.reshape(100, 6)
    np.testing.assert_allclose(held.information, 4.0 * J.T @ J, rtol=1e-9)
    assert np.linalg.eigvalsh(by_cube.information).min() > 0


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_a_field_that_shows_nothing_moves_nothing(background):
    _, images = displaced(1, 0.004)

    def nothing(rays):
        n = len(rays)
        return RenderedRays(np.full((n, 3), background, np.float32), np.ones(n, np.float32), np.zeros(n, np.float32))

    pose_deltas = refined([RefinablePhoto(images[0], FREE)], np.zeros((1, 6)), nothing, np.ones((1, 3)), WHITE)
    np.testing.assert_array_equal(pose_deltas, 0.0)


def test_training_moves_photos_and_goes_on_from_a_checkpoint_to_the_same_bytes():
    images = ball_images()
    off = images[2].cam_from_world.retract(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.02]))
    images = (*images[:2], replace(images[2], cam_from_world=off), *images[3:])
    plan = plan_of(
        finest=24, steps=(10, 15, 15, 15, 10, 5, 5, 5), num_chunks=2, samples_per_chunk=512, refine_poses=True
    )
    with ThreadPoolExecutor(2) as executor:
        training = prepare_grid_training(images, FRAME, plan, seed=3, executor=executor, refine_poses=True)
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
    images = ball_images(3)
    seen = {}
    for image in images:
        towards = image.cam_from_world.target_origin_in_source()
        p = np.random.default_rng(0).normal(size=(60, 3)) * 0.2 + towards / np.linalg.norm(towards)
        seen[image.name] = SeenPoints(0.8 * p / np.linalg.norm(p, axis=1, keepdims=True), np.full(60, 0.01))
    plan = plan_of(finest=24, steps=(2,) * 8, num_chunks=2, samples_per_chunk=512, box_warm_up=False, refine_poses=True)
    with ThreadPoolExecutor(1) as executor:
        work = prepare_grid_training(images, FRAME, plan, seed=0, executor=executor, seen=seen, refine_poses=True)
        saved = {name: array.copy() for name, array in work.to_tensors(work.start()).items()}
        saved["moved"][1] = [0.0, 0.02, 0.0, 0.1, 0.0, 0.0]
        state = work.from_tensors(saved)
    assert len(state.depth_rays.image) > 0
    np.testing.assert_array_equal(state.depth_rays.centers, state.rays.centers)
    np.testing.assert_array_equal(state.depth_rays.rotations, state.rays.rotations)
    pose_deltas = images[1].cam_from_world.retract(saved["moved"][1]).target_origin_in_source()
    np.testing.assert_allclose(state.depth_rays.centers[1], pose_deltas, atol=1e-6)


def test_a_lens_with_pixels_that_no_ray_reaches_is_compared_where_it_shows_something():
    lens = Camera("OPENCV_FISHEYE", 64, 64, np.array([18.0, 18.0, 32.0, 32.0, -0.3, 0.0, 0.0, 0.0]))
    image = ball_images(1)[0]
    wide = PosedImage("wide", lens, image.cam_from_world, np.full((64, 64, 3), 200, np.uint8))
    rays = rays_from_view(lens, wide.cam_from_world)
    assert not np.isfinite(rays.directions).all()

    def finite_only(rays):
        assert np.isfinite(rays.directions).all()
        return textured_ball(rays)

    (photo,) = refinable_photos((wide,), FRAME, None)
    assert np.isfinite(refined((photo,), np.zeros((1, 6)), finite_only, np.ones((1, 3)), WHITE)).all()
