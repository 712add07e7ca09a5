"""Which tiles of the reduced camera system exist, and whether it is worth factoring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from fieldstone.solve.algebra.tile_cholesky_numba import MAX_ROWS
from fieldstone.solve.bundle.layout import BundleLayout
from fieldstone.solve.bundle.schur_numba import mark_shared_tiles_numba

MAX_SINGLE_TILE = 128
"""Reduced systems up to this size are factored as one tile, without BLAS."""
FACTOR_PER_OBSERVATION = 1.5e4
"""Multiply-adds of a factorisation, for each observation, beyond which conjugate gradients take less time."""
MAX_FACTOR_BYTES = 4e9
"""Larger factors are not stored."""


@dataclass(frozen=True, eq=False)
class TilePattern:
    """Which tiles of the reduced system exist; tiles beyond `num_given` appear only in the factor.

    Where the system is not factored, the tiles are those of its block diagonal.
    """

    per_tile: int
    index: Int[np.ndarray, "t t"]
    num_given: int
    num_tiles: int
    num_products: int
    """Tile products of one factorisation."""
    direct: bool = True
    """Whether the system is factored, or solved by conjugate gradients."""

    @property
    def given_index(self) -> Int[np.ndarray, "t t"]:
        """`index` without the tiles that only factorisation fills in."""
        return np.where(self.index < self.num_given, self.index, -1)


def tile_pattern(layout: BundleLayout, factor_per_observation: float | None = FACTOR_PER_OBSERVATION) -> TilePattern:
    """Tiles of free views that share points, and those that factorisation fills in.

    Args:
        factor_per_observation: Multiply-adds of a factorisation that is worth it, for each observation; where it takes
            more the pattern is that of the block diagonal. None: the factor is needed, whatever it takes.
    """
    limit = MAX_SINGLE_TILE if layout.num_columns <= MAX_SINGLE_TILE else MAX_ROWS
    per_tile = max(1, min(limit // layout.block, layout.num_free_views))
    count = -(-layout.num_free_views // per_tile)
    exists = np.eye(count, dtype=bool)
    if count > 1:
        mark_shared_tiles_numba(layout, per_tile, exists)
    index, num_tiles = _with_fill_in(exists)
    per_column = np.sum(np.tril(index >= 0, -1), axis=0)
    num_products = int(np.sum(per_column * (per_column + 3) // 2))
    size = per_tile * layout.block
    too_expensive = factor_per_observation is not None and (
        num_products * size**3 > factor_per_observation * len(layout.view_of_obs)
        or 8 * num_tiles * size**2 > MAX_FACTOR_BYTES
    )
    if too_expensive:
        diagonal = np.where(np.eye(count, dtype=bool), np.arange(count), -1)
        return TilePattern(per_tile, diagonal, count, count, 0, direct=False)
    return TilePattern(per_tile, index, int(exists.sum()), num_tiles, num_products)


def _with_fill_in(exists: Bool[np.ndarray, "t t"]) -> tuple[Int[np.ndarray, "t t"], int]:
    """Number of every tile, given ones first and then those that factorisation fills in; and how many there are."""
    count = len(exists)
    index = np.full((count, count), -1)
    index[exists] = np.arange(exists.sum())
    num_tiles = int(exists.sum())
    for k in range(count):
        rows = k + 1 + np.flatnonzero(index[k + 1 :, k] >= 0)
        i, j = np.meshgrid(rows, rows, indexing="ij")
        fill = (i >= j) & (index[i, j] < 0)
        index[i[fill], j[fill]] = num_tiles + np.arange(fill.sum())
        num_tiles += int(fill.sum())
    return index, num_tiles
