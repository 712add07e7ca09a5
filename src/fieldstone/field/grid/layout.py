"""The feature grids of the grid field: dense vertex grids of doubling resolution over one box.

Each vertex holds four numbers: a part of the log density and three colour features. A point takes the trilinear
mean of the eight vertices around it on every level. Log densities add up over the levels, so the coarse ones move
whole regions while the fine ones still know nothing; features are handed to the decoder side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

CHANNELS = 4
"""Numbers per vertex: log density, then three colour features."""

PADDING = 128
"""Unused numbers behind each level, so that eight-lane loads at its last vertex stay inside the table; levels begin at
multiples of it, where pieces of the table are cut."""


class GridArrays(NamedTuple):
    """A grid as the kernels take it."""

    table: np.ndarray
    """float32, flat: level by level, vertices in C order (x slowest), channels last."""
    sizes: np.ndarray
    """int64 (3 l): vertices along x, y, z of each level."""
    offsets: np.ndarray
    """int64 (l + 1): where in `table` each level starts."""
    per_unit: np.ndarray
    """float32 (l): vertices per unit of length."""


@dataclass(frozen=True, eq=False)
class GridLayout:
    """Which vertices there are. Coordinates are relative to the lower corner of the box."""

    extent: Float[np.ndarray, "3"]
    resolutions: tuple[int, ...]
    """Cells along the longest side of the box, coarse to fine."""
    sizes: Int[np.ndarray, "l 3"]
    offsets: Int[np.ndarray, "l_plus_1"]
    spacings: Float[np.ndarray, "l"]

    @property
    def num_levels(self) -> int:
        """Number of resolutions."""
        return len(self.resolutions)

    @property
    def num_values(self) -> int:
        """Length of the table."""
        return int(self.offsets[-1])

    def arrays(self, table: Float[np.ndarray, "t"]) -> GridArrays:
        """Layout and table for the kernels."""
        per_unit = (1.0 / self.spacings).astype(np.float32)
        return GridArrays(table, np.ascontiguousarray(self.sizes.reshape(-1)), self.offsets, per_unit)

    def level(self, table: Float[np.ndarray, "t"], level: int) -> Float[np.ndarray, "x y z c"]:
        """The vertices of one level, a view into the table."""
        size = self.sizes[level]
        start = int(self.offsets[level])
        return table[start : start + int(np.prod(size)) * CHANNELS].reshape(*size.tolist(), CHANNELS)


def grid_layout(extent: Float[np.ndarray, "3"], resolutions: tuple[int, ...]) -> GridLayout:
    """Grids with cubic cells over a box.

    One more vertex than needed on each side lets a point on the upper face find its cell without a test.
    """
    if not resolutions or min(resolutions) < 1:
        raise ValueError(f"a grid needs resolutions of at least 1, got {resolutions}")
    spacings = float(np.max(extent)) / np.array(resolutions, dtype=np.float64)
    sizes = np.maximum(np.ceil(extent[None] / spacings[:, None] - 1e-4), 1).astype(np.int64) + 2
    lengths = np.prod(sizes, axis=1) * CHANNELS + PADDING
    lengths = -(-lengths // PADDING) * PADDING
    return GridLayout(extent, resolutions, sizes, np.concatenate([[0], np.cumsum(lengths)]), spacings)


def level_resolutions(finest: int, coarsest: int) -> tuple[int, ...]:
    """finest, finest / 2, finest / 4, ... down to about `coarsest`, coarse to fine."""
    levels = [finest]
    while levels[0] // 2 >= coarsest:
        levels.insert(0, levels[0] // 2)
    return tuple(levels)


def interpolate(
    layout: GridLayout, table: Float[np.ndarray, "t"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n l c"]:
    """Trilinear means of the vertices around each point, level by level; float64.

    Args:
        points: Inside the box, relative to its lower corner.
    """
    out = np.empty((len(points), layout.num_levels, CHANNELS))
    for level in range(layout.num_levels):
        vertices = layout.level(table, level)
        x = points / layout.spacings[level]
        cell = np.floor(x).astype(np.int64)
        f = x - cell
        value = np.zeros((len(points), CHANNELS))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(np.array(corner) == 1, f, 1.0 - f), axis=1)
            i, j, k = (cell + np.array(corner)).T
            value += weight[:, None] * vertices[i, j, k]
        out[:, level] = value
    return out
