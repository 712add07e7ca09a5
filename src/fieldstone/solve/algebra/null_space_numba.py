"""Null space of a few linear equations, compiled for the minimal solvers."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def null_space_numba(A, N):  # (m, k) columns are the equations, destroyed; fills N (m, m - k)
    """Orthonormal basis of {x : A^T x = 0} for k < m independent equations, by Householder reflections.

    A = Q R; the last m - k columns of Q are the null space. Equations that depend on each other give a basis of
    a part of the null space.

    Source:
        `golub2013`, section 5.2.
    """
    m, k = A.shape
    for j in range(k):
        norm = 0.0
        for i in range(j, m):
            norm += A[i, j] * A[i, j]
        norm = np.sqrt(norm)
        if norm == 0.0:
            continue
        # v = x + sign(x_j) |x| e_j, kept in place and scaled so that the reflection is I - v v^T.
        alpha = norm if A[j, j] >= 0.0 else -norm
        A[j, j] += alpha
        s = 1.0 / np.sqrt(alpha * A[j, j])
        for i in range(j, m):
            A[i, j] *= s
        for c in range(j + 1, k):
            dot = 0.0
            for i in range(j, m):
                dot += A[i, j] * A[i, c]
            for i in range(j, m):
                A[i, c] -= dot * A[i, j]
    for c in range(m - k):
        for i in range(m):
            N[i, c] = 1.0 if i == k + c else 0.0
        for j in range(k - 1, -1, -1):
            dot = 0.0
            for i in range(j, m):
                dot += A[i, j] * N[i, c]
            for i in range(j, m):
                N[i, c] -= dot * A[i, j]
