import numpy as np
import pytest

from fieldstone.solve.algebra.tile_cholesky_numba import (
    cholesky_in_place_numba,
    factor_column_numba,
    factor_diagonal_numba,
    factor_numba,
    invert_lower_numba,
    solve_transposed_numba,
)

BLOCK, PER_TILE, SLOTS, WIDE_ROWS = 3, 2, 7, 70
TILES = 4


def random_tiled_matrix(density: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """A positive definite matrix of 7 slots, its blocks in tiles, the tile index with fill, and the tile count."""
    rng = np.random.default_rng(3)
    exists = np.tril(rng.random((TILES, TILES)) < density) | np.eye(TILES, dtype=bool)
    index = np.full((TILES, TILES), -1)
    index[exists] = np.arange(exists.sum())
    num_given = num_tiles = int(exists.sum())
    for k in range(TILES):
        for i in range(k + 1, TILES):
            for j in range(k + 1, i + 1):
                if index[i, k] >= 0 and index[j, k] >= 0 and index[i, j] < 0:
                    index[i, j] = num_tiles
                    num_tiles += 1
    size = BLOCK * PER_TILE * TILES
    A = rng.normal(size=(size, size))
    A = np.tril(A) * np.kron(exists, np.ones((BLOCK * PER_TILE,) * 2))
    A = A + A.T + 40 * np.eye(size)
    n = SLOTS * BLOCK
    blocks = np.full((num_given, PER_TILE, PER_TILE, BLOCK, BLOCK), np.nan)
    for i in range(SLOTS):
        for j in range(SLOTS):
            tile = index[i // PER_TILE, j // PER_TILE]
            if 0 <= tile < num_given and j <= i:
                blocks[tile, i % PER_TILE, j % PER_TILE] = A[BLOCK * i : BLOCK * (i + 1), BLOCK * j : BLOCK * (j + 1)]
    return A[:n, :n], np.nan_to_num(blocks), index, num_tiles


@pytest.mark.parametrize("density", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("by_column", [False, True])
def test_solves_what_numpy_solves(density, by_column):
    A, blocks, index, num_tiles = random_tiled_matrix(density)
    n, size = len(A), BLOCK * PER_TILE
    B = np.random.default_rng(1).normal(size=(WIDE_ROWS, n))
    wide = np.zeros((WIDE_ROWS, TILES * size))
    wide[:, :n] = B
    wide = np.ascontiguousarray(wide.reshape(WIDE_ROWS, TILES, size).swapaxes(0, 1))
    L, L_inv = np.empty((num_tiles, size, size)), np.empty((TILES, size, size))
    if by_column:
        for J in range(TILES):
            assert factor_diagonal_numba(J, blocks, index, L, L_inv, SLOTS)
            for start in (1, 0):
                factor_column_numba(J, start, 2, blocks, index, L, L_inv, SLOTS, wide)
    else:
        assert factor_numba(blocks, index, L, L_inv, SLOTS, wide)
    expected = np.linalg.cholesky(A)
    for i in range(TILES):
        for j in range(i + 1):
            rows, columns = slice(size * i, size * (i + 1)), slice(size * j, size * (j + 1))
            part = expected[rows, columns]
            actual = L[index[i, j]] if index[i, j] >= 0 else np.zeros((size, size))
            np.testing.assert_allclose(actual[: part.shape[0], : part.shape[1]], part, atol=1e-12)
    flat = wide.swapaxes(0, 1).reshape(WIDE_ROWS, -1)
    np.testing.assert_allclose(flat[:, :n], np.linalg.solve(expected, B.T).T, atol=1e-12)
    x = np.ascontiguousarray(flat[0].reshape(TILES, size))
    solve_transposed_numba(index, L, L_inv, x)
    np.testing.assert_allclose(x.ravel()[:n], np.linalg.solve(A, B[0]), atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 7, 61])
def test_factor_and_inverse_of_one_tile(n):
    M = np.random.default_rng(n).normal(size=(n, n))
    A = M @ M.T + n * np.eye(n)
    L = np.tril(A)
    assert cholesky_in_place_numba(L)
    np.testing.assert_allclose(L, np.linalg.cholesky(A), rtol=1e-9, atol=1e-12)
    L_inv = np.empty((n, n))
    invert_lower_numba(L, L_inv)
    np.testing.assert_allclose(L_inv @ L, np.eye(n), atol=1e-12)
    assert not cholesky_in_place_numba(-A)
