from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numba import njit

from fieldstone.field.base.space import box_space
from fieldstone.field.grid.field import occupancy_box
from fieldstone.field.grid.march_numba import distance_at
from fieldstone.field.grid.occupancy import MAX_DISTANCE, Occupancy, cell_distances, full_box, visual_hull
from grid_scenes import CAMERA, RADIUS, ball_photos


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


@njit
def look_up(box, shape):
    """Distances of all cells, as the kernels find them."""
    found = np.empty(shape, np.uint8)
    for cell in np.ndindex(shape):
        found[cell] = distance_at(box, cell[0], cell[1], cell[2])
    return found


@pytest.mark.parametrize("shape", [(9, 4, 13), (1, 1, 1), (8, 5, 4)])
def test_kernels_find_the_distance_of_every_cell(shape):
    cells = np.random.default_rng(0).random(shape) < 0.02
    occupancy = Occupancy(np.zeros(3), 0.5, cells)
    box = occupancy_box(occupancy, occupancy.extent, box_space())
    np.testing.assert_array_equal(look_up(box, shape), cell_distances(cells))


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
    photos = ball_photos(24)
    box = full_box(np.full(3, -1.5), np.full(3, 3.0), 16)
    masks = [rgba[..., 3] > 0 for rgba in photos.pixels]
    poses = [photos.posed.pose_of(v) for v in range(24)]
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
