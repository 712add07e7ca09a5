from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fast_scenes import CAMERA, RADIUS, ball_images
from fieldstone.field.occupancy import MAX_DISTANCE, Occupancy, cell_distances, full_box, in_bricks, visual_hull


@pytest.mark.parametrize("share", [0.0, 0.002, 0.05, 1.0])
def test_distances_match_brute_force(share):
    rng = np.random.default_rng(0)
    cells = rng.random((13, 9, 21)) < share
    occupied = np.argwhere(cells)
    index = np.stack(np.meshgrid(*map(np.arange, cells.shape), indexing="ij"), axis=-1)
    expected = np.full(cells.shape, MAX_DISTANCE)
    for cell in occupied:
        expected = np.minimum(expected, np.abs(index - cell).max(axis=-1))
    np.testing.assert_array_equal(cell_distances(cells), expected)


def test_bricks_hold_every_value_at_its_place():
    values = np.random.default_rng(0).integers(0, 256, (9, 4, 13), dtype=np.uint8)
    flat, bricks = in_bricks(values)
    assert bricks.tolist() == [3, 1, 4]
    for cell, value in np.ndenumerate(values):
        outer, (i, j, k) = np.array(cell) // 4, np.array(cell) % 4
        assert flat[64 * np.ravel_multi_index(outer, bricks) + 16 * i + 4 * j + k] == value


@pytest.mark.parametrize("cell_size", [0.05, 0.1, 0.07, 0.31])
def test_resampling_never_loses_an_occupied_point(cell_size):
    rng = np.random.default_rng(0)
    old = Occupancy(np.array([-1.0, 0.0, 2.0]), 0.1, rng.random((12, 7, 9)) < 0.1)
    new = old.resampled(cell_size)
    points = old.lower + rng.random((20_000, 3)) * old.extent

    def occupied(occupancy):
        cell = ((points - occupancy.lower) / occupancy.cell_size).astype(int)
        return occupancy.cells[tuple(np.minimum(cell, np.array(occupancy.cells.shape) - 1).T)]

    assert np.all(occupied(new) >= occupied(old))
    if cell_size == 0.05:
        assert np.mean(occupied(new)) == pytest.approx(np.mean(occupied(old)), abs=1e-9)


def test_the_hull_of_a_ball_contains_it_and_little_else():
    images = ball_images(24)
    box = full_box(np.full(3, -1.5), np.full(3, 3.0), 16)
    masks = [image.pixels[..., 3] > 0 for image in images]
    poses = [image.cam_from_world for image in images]
    with ThreadPoolExecutor(2) as executor:
        hull = visual_hull(box, masks, [CAMERA] * 24, poses, 32, executor)
    distance = np.linalg.norm(hull.centers(), axis=1).reshape(hull.cells.shape)
    assert hull.cells[distance < RADIUS].all()
    # All photos are taken from the side: only there, silhouettes bound the ball from everywhere.
    low = np.abs(hull.centers()[:, 2]).reshape(hull.cells.shape) < 0.4
    assert not hull.cells[low & (distance > 1.5 * RADIUS)].any()
    trimmed = hull.trimmed()
    assert np.count_nonzero(trimmed.cells) == np.count_nonzero(hull.cells)
    assert np.all(trimmed.extent < hull.extent)


def test_an_empty_box_stays():
    box = Occupancy(np.zeros(3), 0.5, np.zeros((2, 2, 2), dtype=bool))
    assert box.trimmed().cells.shape == (2, 2, 2)
