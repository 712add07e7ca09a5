from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.field.base.projection import projection_for
from fieldstone.field.base.ray_dataset import NORMALIZED_RADIUS, SeenPoints
from fieldstone.field.base.space import contracted_space, grid_from_normalized, projective_space
from fieldstone.field.evidence.free_space import (
    carve_free_space,
    corners_in_world,
    free_distances,
)
from fieldstone.field.evidence.options import FreeSpaceOptions
from fieldstone.field.grid.occupancy import full_box
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.rays import rays_from_view
from grid_scenes import CAMERA, FRAME, photographs

PIXELS = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
WALL = 4.0
WORKER = ThreadPoolExecutor(1)


def wall_scene(count):
    """Cameras side by side before a wall at z = 4, and what they see of it."""
    rng = np.random.default_rng(0)
    poses, seen = [Rigid3(np.eye(3), np.array([0.05 * k, 0.0, 0.0])) for k in range(count)], []
    for pose in poses:
        wall = np.column_stack([rng.uniform(-3, 3, (4000, 2)), np.full(4000, WALL)])
        pixels = image_from_cam(CAMERA, pose.apply(wall))
        inside = np.all((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height]), axis=1)
        seen.append(SeenPoints(wall[inside], np.full(np.count_nonzero(inside), 0.01)))
    return photographs(CAMERA, poses, [PIXELS] * count).posed, seen


def box():
    """All of contracted space."""
    return full_box(np.full(3, -2 * NORMALIZED_RADIUS), np.full(3, 4 * NORMALIZED_RADIUS), 48)


def carved_before_wall(count):
    """What the photos of the wall see of it, the box before carving and after, and the corners of its cells."""
    photos, seen = wall_scene(count)
    start = box()
    carved = carve_free_space(start, photos, FRAME, seen, contracted_space(), WORKER)
    return seen, start, carved.cells, corners_in_world(start, FRAME, contracted_space())


def test_the_space_before_a_wall_is_free_and_the_wall_is_not():
    seen, start, cells, corners = carved_before_wall(3)
    near, far = corners[:-1, :-1, :-1], corners[1:, 1:, 1:]
    # Cells that hold a point of the wall are kept.
    for points in seen:
        before_plane = 0.999 * points.xyz  # the wall itself is a plane that cells share
        places = grid_from_normalized(contracted_space(), FRAME.normalized_from_world.apply(before_plane))
        assert cells[tuple(((places - start.lower) / start.cell_size).astype(int).T)].all()
    # A cell in front of all cameras, well before the wall, is free, and so is one behind them; one beyond it is not.
    with np.errstate(invalid="ignore"):
        middle = np.nan_to_num(0.5 * (near + far), nan=1e9)
    before = np.argmin(np.linalg.norm(middle - [0.0, 0.0, 1.5], axis=-1))
    behind = np.argmin(np.linalg.norm(middle - [0.0, 0.0, -1.0], axis=-1))
    beyond = np.argmin(np.linalg.norm(middle - [0.0, 0.0, 2 * WALL], axis=-1))
    assert not cells.reshape(-1)[[before, behind]].any()
    assert cells.reshape(-1)[beyond]


def test_photos_without_points_carve_nothing():
    photos, _ = wall_scene(2)
    start = box()
    few = [SeenPoints(np.array([[0.0, 0, WALL]]), np.array([0.01])), None]
    carved = carve_free_space(start, photos, FRAME, few, contracted_space(), WORKER)
    np.testing.assert_array_equal(carved.cells, start.cells)


def test_what_no_photo_sees_is_empty_around_a_camera_only():
    _, _, cells, corners = carved_before_wall(2)
    of_cell = np.stack([corners[1 - i :, 1 - j :, 1 - k :][:48, :48, :48] for i, j, k in np.ndindex(2, 2, 2)])
    behind, away = (of_cell[..., 2] < 0).all(axis=0), np.linalg.norm(of_cell, axis=-1)
    # The wall is 4 away from both cameras, which are 0.05 apart.
    around = behind & (away.max(axis=0) < FreeSpaceOptions().free_fraction * WALL)
    elsewhere = behind & (away.min(axis=0) > WALL)
    assert around.sum() > 1000
    assert elsewhere.sum() > 1000
    assert not cells[around].any()
    assert cells[elsewhere].all()


def test_what_too_few_photos_see_from_near_is_not_there():
    """A ninth photo that looks elsewhere: nothing stands where it alone sees near places."""
    photos, seen = wall_scene(9)
    aside = Rigid3(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    photos = replace(photos, cam_from_world=Rigid3.stack([*(photos.pose_of(v) for v in range(8)), aside]))
    seen[8] = SeenPoints(aside.inverse().apply(seen[0].xyz), seen[0].sigma)
    start = box()
    carved = carve_free_space(start, photos, FRAME, seen, contracted_space(), WORKER)
    corners = corners_in_world(start, FRAME, contracted_space())
    behind = np.linalg.norm(np.nan_to_num(corners[:-1, :-1, :-1], nan=1e9) - [0.0, 0.0, -0.95 * WALL], axis=-1)
    assert not carved.cells.reshape(-1)[np.argmin(behind)]
    beyond = np.linalg.norm(np.nan_to_num(corners[:-1, :-1, :-1], nan=1e9) - [0.0, 0.0, -2.0 * WALL], axis=-1)
    assert carved.cells.reshape(-1)[np.argmin(beyond)]


@pytest.mark.parametrize("projected", [False, True])
def test_corners_come_back_to_the_grid(projected):
    """The corners, put back into the space of the grid, lie on the grid; infinity is nan."""
    photos, seen = wall_scene(3)
    space, start = contracted_space(), box()
    if projected:
        found = projection_for(photos, FRAME, seen[0].xyz)
        assert found is not None
        projection, bounds = found
        space = projective_space(projection)
        start = full_box(bounds[0], bounds[1] - bounds[0], 16)
    corners = corners_in_world(start, FRAME, space)
    grid = start.lower + start.cell_size * np.stack(
        np.meshgrid(*(np.arange(n) for n in corners.shape[:3]), indexing="ij"), axis=-1
    )
    finite = np.isfinite(corners).all(axis=-1)
    assert 0.5 < finite.mean() <= 1.0
    if projected:
        finite &= corners[..., 2] < 1e3
    again = grid_from_normalized(space, corners[finite])
    np.testing.assert_allclose(again, grid[finite], atol=1e-5)


def test_photos_probably_see_nearly_as_far_as_the_points_around():
    photos, seen = wall_scene(2)
    world = Sim3(0.5, np.eye(3), np.zeros(3))
    frame = replace(FRAME, normalized_from_world=world)
    for v in range(2):
        found = free_distances(photos, frame, seen)(v)
        rays = rays_from_view(CAMERA, photos.pose_of(v))
        true = 0.5 * WALL / rays.directions[:, 2]
        # Blocks of pixels take the least of the points around them.
        assert np.all(found < FreeSpaceOptions().free_loss_fraction * true * 1.02)
        assert np.median(found / true) > 0.95 * FreeSpaceOptions().free_loss_fraction
    unknown = free_distances(photos, frame, [None, None])(0)
    np.testing.assert_array_equal(unknown, np.zeros(CAMERA.width * CAMERA.height))


def test_a_photo_with_too_few_points_carves_nothing_until_fewer_are_asked_for():
    """min_points is an option: what it says decides whether the photos of the wall say anything."""
    photos, seen = wall_scene(2)
    start = box()
    kept, carved = (
        carve_free_space(start, photos, FRAME, seen, contracted_space(), WORKER, FreeSpaceOptions(min_points=n))
        for n in (10**6, 20)
    )
    np.testing.assert_array_equal(kept.cells, start.cells)
    assert carved.cells.sum() < start.cells.sum()
    with pytest.raises(ValueError, match="min_points"):
        FreeSpaceOptions(min_points=0)
