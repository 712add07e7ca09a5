import numpy as np
import pytest

from fieldstone.field.grid.interpolation_numba import (
    BLOCK,
    add_gradient,
    interpolate_numba,
    step_by_sample,
    step_touched,
)
from fieldstone.field.grid.layout import CHANNELS, grid_layout, interpolate, level_resolutions
from fieldstone.field.grid_training.update import WORD

EXTENT = np.array([2.0, 1.3, 0.9])
RESOLUTIONS = (4, 8, 16)


def scene(seed=0, n=300):
    rng = np.random.default_rng(seed)
    layout = grid_layout(EXTENT, RESOLUTIONS)
    table = rng.normal(size=layout.num_values).astype(np.float32)
    points = (rng.random((n, 3)) * EXTENT).astype(np.float32)
    # The corners of the box belong to it.
    points[0], points[1] = 0.0, EXTENT
    return rng, layout, table, points


def test_levels_are_halvings_of_the_finest():
    assert level_resolutions(128, 14) == (16, 32, 64, 128)
    assert level_resolutions(10, 14) == (10,)


def test_a_linear_function_is_interpolated_exactly():
    _, layout, table, points = scene()
    slope = np.array([1.0, -2.0, 0.5])
    for level in range(layout.num_levels):
        vertices = layout.level(table, level)
        index = np.stack(np.meshgrid(*map(np.arange, vertices.shape[:3]), indexing="ij"), axis=-1)
        vertices[...] = (index * layout.spacings[level] @ slope + level)[..., None]
    expected = (points @ slope)[:, None] + np.arange(layout.num_levels)
    values = interpolate(layout, table, points.astype(np.float64))
    np.testing.assert_allclose(values, np.repeat(expected[:, :, None], CHANNELS, axis=2), atol=2e-6)


def test_kernel_matches_reference():
    _, layout, table, points = scene()
    values = interpolate_numba(layout.arrays(table), points)
    np.testing.assert_allclose(
        values.reshape(len(points), -1, CHANNELS),
        interpolate(layout, table, points.astype(np.float64)),
        rtol=1e-4,
        atol=1e-5,
    )


def gradient_by_basis(layout, points, gradient):
    """Brute force: the gradient of sum(gradient * values) for each table entry, by linearity."""
    out = np.zeros(layout.num_values)
    for level in range(layout.num_levels):
        vertices = layout.level(out, level)
        x = points / layout.spacings[level]
        cell = np.floor(x).astype(int)
        f = x - cell
        for n in range(len(points)):
            for corner in np.ndindex(2, 2, 2):
                weight = np.prod([f[n, a] if corner[a] else 1 - f[n, a] for a in range(3)])
                vertices[tuple(cell[n] + corner)] += weight * gradient[n, level]
    return out


@pytest.mark.parametrize("chunks", [1, 3])
def test_gradient_is_the_transpose_of_interpolation(chunks):
    rng, layout, table, points = scene()
    gradient = rng.normal(size=(len(points), layout.num_levels, CHANNELS)).astype(np.float32)
    capacity = len(points) // chunks
    grid, counts, positions = layout.arrays(table), np.full(chunks, capacity), points.reshape(-1)
    out = np.zeros(layout.num_values, dtype=np.float32)
    touched = np.zeros(-(-layout.num_values // (8 * BLOCK)) * 8, dtype=np.uint8)
    for level in range(layout.num_levels):
        for half in (0, 1):
            width = 4 * layout.num_levels
            add_gradient(grid, level, half, counts, capacity, positions, gradient.reshape(-1), width, out, touched)
    expected = gradient_by_basis(layout, points.astype(np.float64), gradient)
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-5)
    blocks = np.flatnonzero(out) // BLOCK
    assert np.all(touched[blocks] == 1), "a block with a gradient was not marked"


def test_step_moves_only_what_has_a_gradient():
    rng = np.random.default_rng(1)
    size = 8 * BLOCK * 4
    table, mean_square = rng.normal(size=(2, size)).astype(np.float32)
    mean_square = np.abs(mean_square)
    gradient = np.where(rng.random(size) < 0.1, rng.normal(size=size), 0).astype(np.float32)
    touched = np.zeros(size // BLOCK, dtype=np.uint8)
    touched[np.flatnonzero(gradient) // BLOCK] = 1
    rates = np.array([0.3, 0.1, 0.1, 0.1] * 2, dtype=np.float32)
    decay_factors = np.array([0.9, 1.0, 1.0, 1.0] * 2, dtype=np.float32)
    v = np.where(gradient != 0, 0.9 * mean_square + 0.1 * gradient**2, mean_square)
    step = np.tile(rates, size // 8) * gradient / (np.sqrt(v) + 1e-8)
    p = np.where(gradient != 0, np.tile(decay_factors, size // 8) * table - step, table)
    step_touched(
        table, mean_square, gradient, touched, 0, len(touched), rates, decay_factors, np.float32(0.9), np.float32(1e-8)
    )
    np.testing.assert_allclose(table, p, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(mean_square, v, rtol=1e-5)
    assert not gradient.any()
    assert not touched.any()


def test_stepping_by_sample_is_stepping_one_sample_after_the_other():
    rng, layout, table, points = scene(n=40)
    level = layout.num_levels - 1
    gradient = rng.normal(size=(len(points), layout.num_levels, CHANNELS)).astype(np.float32)
    mean_square = np.abs(rng.normal(size=table.shape)).astype(np.float32)
    rates = np.array([0.3, 0.1, 0.1, 0.1] * 2, dtype=np.float32)
    decay_factors = np.array([0.9, 1.0, 1.0, 1.0] * 2, dtype=np.float32)
    p, v = table.astype(np.float64), mean_square.astype(np.float64)
    for n in range(len(points)):
        only_last = np.where(np.arange(layout.num_levels)[None, :, None] == level, gradient[n : n + 1], 0)
        g = gradient_by_basis(layout, points[n : n + 1].astype(np.float64), only_last)
        i, j, k = (points[n] * layout.arrays(table).per_unit[level]).astype(np.int64)
        reached = np.zeros(len(p))
        layout.level(reached, level)[i : i + 2, j : j + 2, k : k + 2] = 1.0  # also those with weight 0
        seen = reached > 0
        v[seen] = 0.9 * v[seen] + 0.1 * g[seen] ** 2
        rate, keep = (np.tile(values, len(p) // 8) for values in (rates, decay_factors))
        p[seen] = keep[seen] * p[seen] - rate[seen] * g[seen] / (np.sqrt(v[seen]) + 1e-8)
    for half in (0, 1):
        step_by_sample(
            layout.arrays(table),
            level,
            half,
            np.array([len(points)]),
            len(points),
            points.reshape(-1),
            gradient.reshape(-1),
            4 * layout.num_levels,
            mean_square,
            rates,
            decay_factors,
            np.float32(0.9),
            np.float32(1e-8),
        )
    np.testing.assert_allclose(table, p, rtol=1e-3, atol=1e-4)


def test_levels_begin_where_pieces_of_the_table_may():
    for resolutions in ((3,), (5, 10, 20), (7, 14)):
        layout = grid_layout(np.array([1.0, 0.7, 0.4]), resolutions)
        assert not np.any(layout.offsets % WORD)
