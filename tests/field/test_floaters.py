import numpy as np
import pytest

from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.space import box_space, contracted_space, grid_from_normalized
from fieldstone.field.evidence.floaters import without_floaters
from fieldstone.field.evidence.free_space import corners_in_world
from fieldstone.field.grid.occupancy import Occupancy, full_box
from fieldstone.geometry.sim3 import Sim3

SPECK, THING, WALL = (slice(8, 10),) * 3, (slice(8, 12), slice(14, 17), slice(12, 14)), (0, slice(4, 20), slice(4, 20))


@pytest.fixture
def scene():
    """24 cells along each side, all with a thin fog, in which stand a speck, a thing with a point, and a wall."""
    solid = np.zeros((24, 24, 24), dtype=bool)
    for piece in (SPECK, THING, WALL):
        solid[piece] = True
    occupancy = Occupancy(np.full(3, -3.0), 0.25, np.ones(solid.shape, dtype=bool))
    return occupancy, solid, occupancy.lower + 0.25 * (np.array([[11, 16, 13]]) + 0.5)


def test_specks_go_with_their_rim_and_nothing_else(scene):
    occupancy, solid, points_in_grid = scene
    expected = np.ones_like(solid)
    expected[(slice(7, 11),) * 3] = False
    found = without_floaters(occupancy, solid, points_in_grid, contracted_space())
    np.testing.assert_array_equal(found.cells, expected)


def test_in_a_bounded_box_nothing_is_far_away(scene):
    occupancy, solid, points_in_grid = scene
    solid[WALL] = False
    solid[0, 4, 4:6] = True
    found = without_floaters(occupancy, solid, points_in_grid, box_space())
    assert not found.cells[0, 4, 4:6].any()
    assert found.cells[THING].all()


def test_a_point_beside_a_piece_ties_it(scene):
    occupancy, solid, _ = scene
    beside = occupancy.lower + 0.25 * (np.array([[10, 9, 9]]) + 0.5)
    found = without_floaters(occupancy, solid, beside, contracted_space())
    assert found.cells[SPECK].all()
    assert not found.cells[THING].any()


def test_points_that_would_cost_the_scene_most_of_it_are_not_believed(scene):
    occupancy, solid, points_in_grid = scene
    assert without_floaters(occupancy, solid, points_in_grid, box_space()) is occupancy


def test_points_outside_and_at_infinity_tie_nothing(scene):
    occupancy, solid, points_in_grid = scene
    strange = np.vstack([points_in_grid, np.full((1, 3), 50.0), np.full((1, 3), np.nan)])
    found = without_floaters(occupancy, solid, strange, contracted_space())
    np.testing.assert_array_equal(
        found.cells, without_floaters(occupancy, solid, points_in_grid, contracted_space()).cells
    )


def test_places_are_where_the_corners_of_cells_come_from():
    frame = FieldFrame(Sim3(0.5, np.eye(3), np.array([0.1, -0.2, 0.3])), 0.1, 9.0, np.zeros(3))
    box = full_box(np.full(3, -3.0), np.full(3, 6.0), 8)
    corners = corners_in_world(box, frame, contracted_space())[1:-1, 1:-1, 1:-1]  # the outermost: infinity
    normalized = frame.normalized_from_world.apply(corners.reshape(-1, 3))
    points_in_grid = grid_from_normalized(contracted_space(), normalized).reshape(corners.shape)
    index = np.stack(np.meshgrid(*(np.arange(1, 8),) * 3, indexing="ij"), axis=-1)
    np.testing.assert_allclose(points_in_grid, box.lower + index * box.cell_size, atol=1e-9)
