"""Cholesky factorisation of a symmetric positive definite matrix of square tiles, zero tiles left out.

Tiles are small enough (at most 64 x 64) that BLAS multiplies each pair in one thread whatever its settings, and each
tile is summed in a fixed order: the factor has the same bits for any number of threads. Dense and sparse matrices
take the same road, because only the tiles that exist are visited.

Source:
    `buttari2009`, the tiled algorithm; left-looking here.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

MAX_ROWS = 64
"""Rows and columns of a tile at most: BLAS keeps products of this size in one thread."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def cholesky_in_place_numba(A):
    """Lower Cholesky factor of A (n, n) in its lower triangle, zeros above; False if a pivot is not positive.

    Reads the lower triangle. Works on rows of the transpose so that the inner loops are contiguous.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(i):
            A[j, i] = A[i, j]
    for k in range(n):
        if not A[k, k] > 0.0:
            return False
        scale = 1.0 / np.sqrt(A[k, k])
        for j in range(k, n):
            A[k, j] *= scale
        for i in range(k + 1, n):
            factor = A[k, i]
            for j in range(i, n):
                A[i, j] -= factor * A[k, j]
    for i in range(n):
        for j in range(i):
            A[i, j] = A[j, i]
            A[j, i] = 0.0
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def invert_lower_numba(L, L_inv):
    """L_inv with L_inv L = row_tile, for a lower triangular L (n, n)."""
    n = L.shape[0]
    for i in range(n):
        row = L_inv[i]
        for j in range(n):
            row[j] = 0.0
        for k in range(i):
            factor = L[i, k]
            for j in range(k + 1):
                row[j] -= factor * L_inv[k, j]
        scale = 1.0 / L[i, i]
        for j in range(i):
            row[j] *= scale
        row[i] = scale


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def subtract_numba(A, out):
    """out -= A; a loop compiles faster than the array expression."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] -= A[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _update_tile_numba(blocks, tile_index, L, row_tile, col_tile, num_blocks, product, out):
    """out (T, T) = A - sum_k L_row,k L_col,k^T, with the tile A gathered from its blocks.

    Beyond the last block the matrix is the identity.
    """
    per_tile, block = blocks.shape[1], blocks.shape[3]
    tile = tile_index[row_tile, col_tile]
    given = tile < blocks.shape[0]
    for i in range(per_tile):
        inside = row_tile * per_tile + i < num_blocks
        for j in range(per_tile):
            for a in range(block):
                for b in range(block):
                    value = blocks[tile, i, j, a, b] if given and inside else 0.0
                    if not inside and row_tile == col_tile and i == j and a == b:
                        value = 1.0
                    out[i * block + a, j * block + b] = value
    for k in range(col_tile):
        if tile_index[row_tile, k] >= 0 and tile_index[col_tile, k] >= 0:
            np.dot(L[tile_index[row_tile, k]], L[tile_index[col_tile, k]].T, product)
            subtract_numba(product, out)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def factor_diagonal_numba(col_tile, blocks, tile_index, L, L_inv, num_blocks):
    """L_JJ and its inverse L_inv[col_tile]; False if the matrix is not positive definite."""
    out = L[tile_index[col_tile, col_tile]]
    product = np.empty(out.shape)
    _update_tile_numba(blocks, tile_index, L, col_tile, col_tile, num_blocks, product, out)
    if not cholesky_in_place_numba(out):
        return False
    invert_lower_numba(out, L_inv[col_tile])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def factor_column_numba(col_tile, start, step, blocks, tile_index, L, L_inv, num_blocks, wide):
    """Tiles of column col_tile below the diagonal, every `step`-th from `start`.

    `wide` (tiles, rows, T) holds more rows below all tiles, which are brought up to this column as well.
    """
    size = L.shape[1]
    out = np.empty((size, size))
    product = np.empty((size, size))
    num_tiles = tile_index.shape[0]
    for row_tile in range(col_tile + 1 + start, num_tiles, step):
        if tile_index[row_tile, col_tile] >= 0:
            _update_tile_numba(blocks, tile_index, L, row_tile, col_tile, num_blocks, product, out)
            np.dot(out, L_inv[col_tile].T, L[tile_index[row_tile, col_tile]])
    for first in range(start * MAX_ROWS, wide.shape[1], step * MAX_ROWS):
        last = min(first + MAX_ROWS, wide.shape[1])
        rows = np.zeros((last - first, size))
        wide_product = np.empty((last - first, size))
        subtract_numba(wide[col_tile, first:last], rows)
        for k in range(col_tile):
            if tile_index[col_tile, k] >= 0:
                np.dot(wide[k, first:last], L[tile_index[col_tile, k]].T, wide_product)
                for i in range(last - first):
                    for j in range(size):
                        rows[i, j] += wide_product[i, j]
        np.dot(rows, L_inv[col_tile].T, wide_product)
        for i in range(last - first):
            for j in range(size):
                wide[col_tile, first + i, j] = -wide_product[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def factor_numba(blocks, tile_index, L, L_inv, num_blocks, wide):
    """All columns in one thread; False if the matrix is not positive definite."""
    for col_tile in range(tile_index.shape[0]):
        if not factor_diagonal_numba(col_tile, blocks, tile_index, L, L_inv, num_blocks):
            return False
        factor_column_numba(col_tile, 0, 1, blocks, tile_index, L, L_inv, num_blocks, wide)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_transposed_numba(tile_index, L, L_inv, x):
    """In place: x (tiles, T) becomes L^-T x."""
    num_tiles, size = x.shape
    y = np.empty(size)
    for col_tile in range(num_tiles - 1, -1, -1):
        for j in range(size):
            y[j] = x[col_tile, j]
        for row_tile in range(col_tile + 1, num_tiles):
            if tile_index[row_tile, col_tile] >= 0:
                tile = L[tile_index[row_tile, col_tile]]
                for i in range(size):
                    factor = x[row_tile, i]
                    for j in range(size):
                        y[j] -= factor * tile[i, j]
        for j in range(size):
            x[col_tile, j] = 0.0
        for i in range(size):
            factor = y[i]
            for j in range(i + 1):
                x[col_tile, j] += factor * L_inv[col_tile, i, j]
