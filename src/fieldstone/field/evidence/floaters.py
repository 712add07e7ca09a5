"""What hangs in the air: solid pieces that touch nothing else and hold no known point.

A field with few photos explains some pixels by a speck that only one photo looks at, and goes on refining it: longer
training makes it worse. A real thing mostly stands on something, or has texture, and then known points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import label

from fieldstone.field.base.space import Space
from fieldstone.field.evidence.options import DEFAULT_EVIDENCE, FloaterOptions
from fieldstone.field.grid.occupancy import Occupancy, grown_by_one

CORNERS_TOO = np.ones((3, 3, 3))
"""Cells that share a corner touch."""


def without_floaters(
    occupancy: Occupancy,
    solid: Bool[np.ndarray, "x y z"],
    points_in_grid: Float[np.ndarray, "p 3"],
    space: Space,
    options: FloaterOptions = DEFAULT_EVIDENCE.floaters,
) -> Occupancy:
    """The occupancy without the pieces of solid cells that are tied to nothing, and without the rim around them.

    A piece is tied if there is a known point in it or beside it, or if it reaches the contracted surroundings: what is
    far away is often seen without any point on it. Where `FloaterOptions.max_fraction` is exceeded, everything stays.

    Args:
        points_in_grid: Triangulated points.
    """
    shape = np.array(solid.shape)
    cell = np.floor((points_in_grid - occupancy.lower) / occupancy.cell_size)
    cell = cell[np.all((cell >= 0) & (cell < shape), axis=1)].astype(np.int64)  # nan is not inside
    ties = np.zeros(solid.shape, dtype=bool)
    ties[tuple(cell.T)] = True
    ties = grown_by_one(ties)
    if space.is_contracted:
        inner = np.zeros_like(ties)
        inner[tuple(slice(n // 4, n - n // 4) for n in solid.shape)] = True
        ties |= ~inner
    pieces = np.empty(solid.shape, dtype=np.int32)
    label(solid, CORNERS_TOO, output=pieces)
    tied = np.zeros(int(pieces.max()) + 1, dtype=bool)
    tied[pieces[ties]] = True
    tied[0] = False
    kept = tied[pieces]
    floating = solid & ~kept
    if np.count_nonzero(floating) > options.max_fraction * np.count_nonzero(solid):
        return occupancy
    return Occupancy(occupancy.lower, occupancy.cell_size, occupancy.cells & ~(grown_by_one(floating) & ~kept))
