"""Fundamental matrices from seven correspondences."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.solve.algebra.null_space_numba import null_space_numba
from fieldstone.solve.algebra.polynomial_roots import real_roots_of_cubic

MAX_SOLUTIONS = 3


def seven_point(x1: Float[np.ndarray, "7 3"], x2: Float[np.ndarray, "7 3"]) -> list[Float[np.ndarray, "3 3"]]:
    """All real fundamental matrices (one to three) of seven correspondences x2^T F x1 = 0, |F| = 1.

    Seven equations leave F = s F1 + (1 - s) F2; det(F) = 0 is a cubic in s.

    Points on a plane, and pure rotation, leave F undetermined: the answers then fit the equations but mean nothing.

    Args:
        x1, x2: Homogeneous coordinates of similar size, best with their centre at the origin and |x| about 1.

    Source:
        `hartley2004`, section 11.1.2.
    """
    models = np.empty((MAX_SOLUTIONS, 12))
    count = seven_point_numba(np.ascontiguousarray(x1, np.float64), np.ascontiguousarray(x2, np.float64), models)
    return [models[k, :9].reshape(3, 3).copy() for k in range(count)]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def seven_point_numba(a, b, models):  # (>= 7, 3), (>= 7, 3) -> count; fills models (3, 12), first 9 of each row
    """`seven_point` into preallocated rows."""
    A, N = np.empty((9, 7)), np.empty((9, 2))
    for k in range(7):
        for i in range(3):
            for j in range(3):
                A[3 * i + j, k] = b[k, i] * a[k, j]
    null_space_numba(A, N)
    # det(F2 + s (F1 - F2)) at four values of s gives the four coefficients.
    d0, d1 = _determinant(N, 0.0), _determinant(N, 1.0)
    dm, d2 = _determinant(N, -1.0), _determinant(N, 2.0)
    c2 = 0.5 * (d1 + dm) - d0
    c3 = (d2 - 2.0 * d1 + d0 - 2.0 * c2) / 6.0
    c1 = d1 - d0 - c2 - c3
    count, s0, s1, s2 = real_roots_of_cubic(d0, c1, c2, c3)
    kept = 0
    for k in range(count):
        s = s0 if k == 0 else (s1 if k == 1 else s2)
        norm2 = 0.0
        for i in range(9):
            models[kept, i] = s * N[i, 0] + (1.0 - s) * N[i, 1]
            norm2 += models[kept, i] * models[kept, i]
        h = 1.0 / np.sqrt(norm2)
        if np.isfinite(h):
            for i in range(9):
                models[kept, i] *= h
            kept += 1
    return kept


@njit(cache=True, nogil=True)
@no_type_check
def _determinant(N, s):
    """det(s F1 + (1 - s) F2)."""
    r = 1.0 - s
    a, b, c = s * N[0, 0] + r * N[0, 1], s * N[1, 0] + r * N[1, 1], s * N[2, 0] + r * N[2, 1]
    d, e, f = s * N[3, 0] + r * N[3, 1], s * N[4, 0] + r * N[4, 1], s * N[5, 0] + r * N[5, 1]
    g, h, i = s * N[6, 0] + r * N[6, 1], s * N[7, 0] + r * N[7, 1], s * N[8, 0] + r * N[8, 1]
    return a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
