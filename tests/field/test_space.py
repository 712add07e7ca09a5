"""The spaces of the grids: there and back, against finite differences, and the kernels against the reference."""

import numpy as np
import pytest

from fieldstone.field.base.projection import Projection
from fieldstone.field.base.space import (
    along_rays,
    box_space,
    contracted_space,
    expected_distance,
    finite_box,
    grid_from_normalized,
    marched_rays,
    normalized_from_grid,
    projective_space,
    stretch,
)
from fieldstone.field.base.space_numba import contract_numba
from fieldstone.geometry.rotation import exp

SIDE = 1.25
SPACES = {
    "box": box_space(),
    "contracted": contracted_space(SIDE),
    "projective": projective_space(
        Projection(
            exp(np.array([0.2, -0.1, 0.3])).astype(np.float32),
            np.array([0.1, 0.2, -0.3], np.float32),
            np.float32(1.5),
            np.float32(0.8),
        )
    ),
}
all_spaces = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES.keys())


def points_ahead(count=500, seed=0):
    """Points from near to far, in all directions of the first spaces and ahead of the camera of the last."""
    rng = np.random.default_rng(seed)
    projection = SPACES["projective"].projection
    z = np.exp(rng.uniform(np.log(1.6), np.log(60.0), count))
    in_cam = np.column_stack([rng.uniform(-0.8, 0.8, (count, 2)) * z[:, None], z])
    return in_cam @ projection.R.astype(np.float64) + projection.center


@all_spaces
def test_points_come_back(space):
    points = points_ahead()
    in_grid = grid_from_normalized(space, points)
    # float32 in the projection: relative 1e-7, times z / near on the way back.
    np.testing.assert_allclose(normalized_from_grid(space, in_grid), points, rtol=1e-4, atol=1e-4)


def test_contraction_keeps_the_inner_cube_and_puts_infinity_on_the_faces_of_one_twice_as_large():
    space = SPACES["contracted"]
    inner = np.random.default_rng(1).uniform(-SIDE, SIDE, (50, 3))
    np.testing.assert_array_equal(grid_from_normalized(space, inner), inner)
    far = grid_from_normalized(space, 1e9 * inner)
    np.testing.assert_allclose(np.abs(far).max(axis=1), 2 * SIDE, rtol=1e-7)
    assert not np.isfinite(normalized_from_grid(space, np.array([[2 * SIDE, 0.0, 0.0]]))).all()


def test_contraction_is_that_of_a_cube_where_the_norm_is_the_largest_coordinate():
    """Along an axis, `barron2022` eq. 10: 2 - 1 / x for x > 1."""
    x = np.array([0.5, 1.0, 1.5, 4.0, 100.0])
    found = grid_from_normalized(SPACES["contracted"], SIDE * np.column_stack([x, 0 * x, 0 * x]))
    np.testing.assert_allclose(found[:, 0] / SIDE, np.where(x > 1, 2 - 1 / x, x), rtol=1e-12)


@pytest.mark.parametrize("name", ["box", "contracted"])
def test_stretch_is_the_inverse_of_the_derivative_along_a_ray_from_the_middle(name):
    """Central differences of the largest coordinate: what a step of the march has to be for equal steps in the grid."""
    space, points, h = SPACES[name], points_ahead(), 1e-6
    ahead, behind = (np.abs(grid_from_normalized(space, points * (1 + s))).max(axis=1) for s in (h, -h))
    length = np.abs(points).max(axis=1)
    np.testing.assert_allclose(2 * h * length / (ahead - behind), stretch(space, points), rtol=1e-4)


@all_spaces
def test_points_on_rays_are_where_the_march_finds_them(space):
    """At t from the marched ray of its camera lies the point, and sigma further on the point that is farther."""
    points, center, sigma = points_ahead(), np.array([0.05, -0.1, 0.1]), np.full(500, 1e-3)
    t, spread, _ = along_rays(space, center, points, sigma)
    directions = (points - center) / np.linalg.norm(points - center, axis=1, keepdims=True)
    origins = np.tile(center, (len(points), 1))
    start, ahead, length = marched_rays(space, origins, directions)
    assert np.isfinite(t).all()
    assert np.all(t < length)
    for distance, expected in ((t, points), (t + spread, points + sigma[:, None] * directions)):
        reached = start + distance[:, None] * ahead
        if space.is_projective:
            reached = normalized_from_grid(space, reached)
        np.testing.assert_allclose(reached, expected, rtol=2e-4, atol=2e-4)


def test_points_behind_a_projective_space_are_nowhere():
    space = SPACES["projective"]
    behind = space.projection.center - 2.0 * space.projection.R[2].astype(np.float64)
    assert np.isnan(along_rays(space, np.zeros(3), behind[None], np.full(1, 0.1))[0]).all()


@all_spaces
def test_an_opaque_ray_ends_at_its_point_and_an_empty_one_far_away(space):
    points, far = points_ahead(), np.float32(90.0)
    origins = np.zeros_like(points)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    t, _, _ = along_rays(space, np.zeros(3), points, np.full(len(points), 0.1))
    _, _, length = marched_rays(space, origins, directions)
    found = expected_distance(space, origins, directions, length, t, np.ones(len(t)), far)
    np.testing.assert_allclose(found, np.minimum(np.linalg.norm(points, axis=1), far), rtol=1e-3)
    none = expected_distance(space, origins, directions, length, np.full(len(t), far), np.zeros(len(t)), far)
    np.testing.assert_allclose(none, far)


@pytest.mark.parametrize("kernel", [contract_numba, contract_numba.py_func])
def test_contraction_of_the_kernels_is_that_of_the_reference(kernel):
    space, points = SPACES["contracted"], points_ahead()
    half = np.float32(SIDE)
    found = np.array([kernel(*(p + 2 * SIDE).astype(np.float32), half) for p in points])
    np.testing.assert_allclose(found[:, :3] - 2 * SIDE, grid_from_normalized(space, points), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found[:, 3] ** 2, stretch(space, points), rtol=1e-4)


def test_torch_contracts_as_the_reference_does():
    torch = pytest.importorskip("torch")
    from fieldstone.field.grid_torch.march import contracted

    points = points_ahead()
    found = contracted(torch.tensor(points + 2 * SIDE)[:, None], SIDE)[:, 0].numpy() - 2 * SIDE
    np.testing.assert_allclose(found, grid_from_normalized(SPACES["contracted"], points), rtol=1e-9, atol=1e-12)


def test_surfaces_are_looked_for_where_space_is_finite():
    lower, upper = np.full(3, -2 * SIDE), np.full(3, 2 * SIDE)
    low, high = finite_box(SPACES["contracted"], lower, upper)
    np.testing.assert_allclose([low, high], [np.full(3, -SIDE), np.full(3, SIDE)])
    assert finite_box(SPACES["box"], lower, upper) == (lower, upper)
    projective = SPACES["projective"]
    low, high = finite_box(projective, np.zeros(3), np.array([1.0, 1.0, projective.projection.depth]))
    assert np.isfinite(normalized_from_grid(projective, high[None])).all()
