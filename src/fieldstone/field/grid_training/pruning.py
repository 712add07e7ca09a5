"""Cells that are given up while a grid field is trained: what is nowhere dense, and what hangs in the air."""

from __future__ import annotations

import logging
import math
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.field.evidence.floaters import without_floaters
from fieldstone.field.evidence.options import FloaterOptions
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.occupancy import Occupancy
from fieldstone.field.grid.occupancy_numba import used_cells

logger = logging.getLogger(__name__)

CELL_VERTICES = 2
"""An occupancy cell is this many cells of the finest level wide."""

SOLID_DEPTH = 0.1
"""A cell is solid where a step has this optical depth."""

NUM_PIECES = 16
"""Slabs that the cells are split into for the threads."""


def cell_size_for(field: GridField) -> float:
    """The size of cells that suits the grids of a field; cells never grow."""
    return min(float(field.layout.spacings[-1]) * CELL_VERTICES, field.occupancy.cell_size)


def without_empty_cells(field: GridField, density: float, executor: Executor) -> GridField:
    """The field without the cells that are nowhere denser than `density`; unchanged if that were all."""
    occupancy = field.occupancy.resampled(cell_size_for(field), field.layout.extent)
    cells = denser_cells(field, occupancy, density, executor)
    if not cells.any():
        return field
    logger.debug("occupied cells: %.2f %% of %s", 100.0 * cells.mean(), cells.shape)
    return replace(field, occupancy=replace(occupancy, cells=cells))


def without_floating_cells(
    field: GridField, points_in_grid: Float[np.ndarray, "p 3"], options: FloaterOptions, executor: Executor
) -> GridField:
    """The field without solid pieces that are tied to nothing.

    Args:
        points_in_grid: Triangulated points.
    """
    solid = denser_cells(field, field.occupancy, SOLID_DEPTH / field.step_depth, executor)
    occupancy = without_floaters(field.occupancy, solid, points_in_grid, field.space, options)
    cleared = np.count_nonzero(field.occupancy.cells) - np.count_nonzero(occupancy.cells)
    logger.debug("cleared %d cells around what hangs in the air", cleared)
    return replace(field, occupancy=occupancy)


def denser_cells(
    field: GridField, occupancy: Occupancy, density: float, executor: Executor
) -> Bool[np.ndarray, "x y z"]:
    """Which occupied cells are denser than `density` somewhere."""
    grid, cells = field.layout.arrays(field.table), occupancy.cells.copy()
    spacing, bias = float(field.layout.spacings[-1]), np.float32(field.density_bias)
    threshold = np.float32(math.log(density))
    bounds = np.linspace(0, len(cells), NUM_PIECES + 1).astype(np.int64)

    def clear(n: int) -> None:
        used_cells(grid, cells, occupancy.cell_size, spacing, bias, threshold, bounds[n], bounds[n + 1])

    list(executor.map(clear, range(NUM_PIECES)))
    return cells
