"""Essential matrices from five correspondences."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.solve.algebra.cubic_forms_numba import add_product_1_1, add_product_2_1
from fieldstone.solve.algebra.null_space_numba import null_space_numba
from fieldstone.solve.algebra.polynomial_roots import real_roots_numba

MAX_SOLUTIONS = 10


def five_point(x1: Float[np.ndarray, "5 3"], x2: Float[np.ndarray, "5 3"]) -> list[Float[np.ndarray, "3 3"]]:
    """All real essential matrices `cam2_E_cam1` (at most ten) of five correspondences x2^T E x1 = 0, |E| = sqrt(2).

    E = x E1 + y E2 + z E3 + E4 on the null space of the five equations; det(E) = 0 and
    2 E E^T E - trace(E E^T) E = 0 are ten cubics in x, y, z; eliminating x and y leaves a polynomial of degree ten
    in z.

    Works for points on a plane (two of the solutions are then the plane's two motions). Pure rotation leaves E
    undetermined, and so do five points of which four lie on a line; the answers then fit the equations but mean
    nothing.

    Args:
        x1, x2: Bearings, any scale.

    Source:
        `nister2004`. Departure: real roots by Sturm's theorem over the whole line mapped to (-1, 1), and every
        E comes from the rows of the 3x3 system with the largest cross product.
    """
    models = np.empty((MAX_SOLUTIONS, 12))
    a = np.ascontiguousarray(x1 / np.linalg.norm(x1, axis=1, keepdims=True), np.float64)
    b = np.ascontiguousarray(x2 / np.linalg.norm(x2, axis=1, keepdims=True), np.float64)
    count = five_point_numba(a, b, models)
    return [models[k, :9].reshape(3, 3).copy() for k in range(count)]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def five_point_numba(a, b, models):  # (>= 5, 3), (>= 5, 3) -> count; fills models (10, 12), first 9 of each row
    """`five_point` into preallocated rows."""
    A, N = np.empty((9, 5)), np.empty((9, 4))
    for k in range(5):
        for i in range(3):
            for j in range(3):
                A[3 * i + j, k] = b[k, i] * a[k, j]
    null_space_numba(A, N)
    M = np.zeros((10, 20))
    _constraints(N, M)
    if not _eliminate(M):
        return 0
    B, determinant, roots = np.empty((3, 13)), np.zeros(11), np.empty(16)
    _hidden_variable(M, B)
    _determinant(B, determinant)
    count = real_roots_numba(determinant, 10, np.empty((12, 13)), roots)
    kept = 0
    for k in range(count):
        if _essential_at(roots[k], B, N, models[kept]):
            kept += 1
    return kept


@njit(cache=True, nogil=True)
@no_type_check
def _constraints(N, M):
    """Ten cubics as rows of M (zeros on entry): 2 (E E^T - trace / 2) E for nine, det E for the last."""
    EE, minor = np.zeros((6, 10)), np.empty(10)
    k = 0
    for i in range(3):
        for j in range(i, 3):
            for m in range(3):
                add_product_1_1(N[3 * i + m], N[3 * j + m], 1.0, EE[k])
            k += 1
    # Order of EE: 00, 01, 02, 11, 12, 22; minus half of the trace on the diagonal.
    for c in range(10):
        half_trace = 0.5 * (EE[0, c] + EE[3, c] + EE[5, c])
        EE[0, c] -= half_trace
        EE[3, c] -= half_trace
        EE[5, c] -= half_trace
    for j in range(3):
        add_product_2_1(EE[0], N[j], M[j])
        add_product_2_1(EE[1], N[3 + j], M[j])
        add_product_2_1(EE[2], N[6 + j], M[j])
        add_product_2_1(EE[1], N[j], M[3 + j])
        add_product_2_1(EE[3], N[3 + j], M[3 + j])
        add_product_2_1(EE[4], N[6 + j], M[3 + j])
        add_product_2_1(EE[2], N[j], M[6 + j])
        add_product_2_1(EE[4], N[3 + j], M[6 + j])
        add_product_2_1(EE[5], N[6 + j], M[6 + j])
    for j in range(3):
        p, q = (j + 1) % 3, (j + 2) % 3
        for c in range(10):
            minor[c] = 0.0
        add_product_1_1(N[p], N[3 + q], 1.0, minor)
        add_product_1_1(N[q], N[3 + p], -1.0, minor)
        add_product_2_1(minor, N[6 + j], M[9])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _eliminate(M):
    """Gaussian elimination of the first ten columns; rows 4 to 9 are reduced fully, the others are not needed."""
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(M[i, k]) > abs(M[pivot, k]):
                pivot = i
        if not abs(M[pivot, k]) > 1e-30:
            return False
        if pivot != k:
            for j in range(k, 20):
                M[k, j], M[pivot, j] = M[pivot, j], M[k, j]
        h = 1.0 / M[k, k]
        for j in range(k, 20):
            M[k, j] *= h
        for i in range(k + 1, 10):
            f = M[i, k]
            for j in range(k, 20):
                M[i, j] -= f * M[k, j]
    for k in range(9, 4, -1):
        for i in range(4, k):
            f = M[i, k]
            for j in range(k, 20):
                M[i, j] -= f * M[k, j]
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _hidden_variable(M, B):
    """Rows <x2z> - z <x2>, <y2z> - z <y2>, <xyz> - z <xy>: B(z) (x, y, 1) = 0, powers of z rising in each block.

    B holds, for each row, four coefficients of the entry of x, four of y, five of 1.
    """
    for r in range(3):
        e, f = M[4 + 2 * r], M[5 + 2 * r]
        for block in range(2):
            s, o = 10 + 3 * block, 4 * block
            B[r, o] = e[s + 2]
            B[r, o + 1] = e[s + 1] - f[s + 2]
            B[r, o + 2] = e[s] - f[s + 1]
            B[r, o + 3] = -f[s]
        B[r, 8] = e[19]
        B[r, 9] = e[18] - f[19]
        B[r, 10] = e[17] - f[18]
        B[r, 11] = e[16] - f[17]
        B[r, 12] = -f[16]


@njit(cache=True, nogil=True)
@no_type_check
def _determinant(B, out):
    """Add det B(z), a polynomial of degree ten, to out: expansion along the column of 1."""
    minor = np.empty(7)
    for r in range(3):
        p, q = (r + 1) % 3, (r + 2) % 3
        for i in range(7):
            minor[i] = 0.0
        for i in range(4):
            for j in range(4):
                minor[i + j] += B[p, i] * B[q, 4 + j] - B[q, i] * B[p, 4 + j]
        for i in range(7):
            for j in range(5):
                out[i + j] += minor[i] * B[r, 8 + j]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _essential_at(z, B, N, model):
    """E of one root: (x, y, 1) is orthogonal to the rows of B(z); the best conditioned pair of rows gives it."""
    best, x, y = 0.0, 0.0, 0.0
    rows = np.empty((3, 3))
    for r in range(3):
        for j in range(3):
            c = B[r, 4 * j : 4 * j + 4]
            rows[r, j] = ((c[3] * z + c[2]) * z + c[1]) * z + c[0]
        rows[r, 2] += B[r, 12] * z * z * z * z
    for r in range(3):
        p, q = (r + 1) % 3, (r + 2) % 3
        p1, p2, p3, q1, q2, q3 = rows[p, 0], rows[p, 1], rows[p, 2], rows[q, 0], rows[q, 1], rows[q, 2]
        c1, c2, c3 = p2 * q3 - p3 * q2, p3 * q1 - p1 * q3, p1 * q2 - p2 * q1
        scale = (p1 * p1 + p2 * p2 + p3 * p3) * (q1 * q1 + q2 * q2 + q3 * q3)
        quality = c3 * c3 / scale if scale > 0.0 else 0.0
        if quality > best:
            best, x, y = quality, c1 / c3, c2 / c3
    if best == 0.0:
        return False
    norm2 = 0.0
    for i in range(9):
        model[i] = x * N[i, 0] + y * N[i, 1] + z * N[i, 2] + N[i, 3]
        norm2 += model[i] * model[i]
    s = np.sqrt(2.0 / norm2)
    for i in range(9):
        model[i] *= s
    return np.isfinite(s) and s > 0.0
