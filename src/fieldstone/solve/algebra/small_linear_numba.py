"""Linear algebra of a few unknowns and random draws, without allocation, for kernels that run per hypothesis."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_damped_numba(S, damping, L, step):  # (k + 1, k + 1), scalar, (k, k) scratch, (k,) out -> solvable
    """step = -(H + damping diag(H))^-1 g by Cholesky's factorisation; False where that is not positive definite.

    S holds H in its first k rows and columns and g in its last row; its lower triangle is read. Diagonal entries
    smaller than 1e-12 of the largest are damped as if they had that size.
    """
    k = len(step)
    largest = 0.0
    for i in range(k):
        if S[i, i] > largest:
            largest = S[i, i]
    if not 0.0 < largest < np.inf:
        return False
    floor = 1e-12 * largest
    for i in range(k):
        for j in range(i + 1):
            s = S[i, j]
            if i == j:
                s += damping * (s if s > floor else floor)
            for m in range(j):
                s -= L[i, m] * L[j, m]
            if i == j:
                if s <= 1e-300:
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(k):
        s = -S[k, i]
        for m in range(i):
            s -= L[i, m] * step[m]
        step[i] = s / L[i, i]
    for i in range(k - 1, -1, -1):
        s = step[i]
        for m in range(i + 1, k):
            s -= L[m, i] * step[m]
        step[i] = s / L[i, i]
    return True


@njit(cache=True, nogil=True)
@no_type_check
def copy_row_numba(source, target):
    """target[:len(source)] = source; cheaper to compile than a slice assignment."""
    for i in range(len(source)):
        target[i] = source[i]


@njit(cache=True, nogil=True)
@no_type_check
def squared_length_numba(v):
    """Sum of squares of a short row."""
    s = 0.0
    for i in range(len(v)):
        s += v[i] * v[i]
    return s


@njit(cache=True, nogil=True)
@no_type_check
def rotation_exp_numba(w1, w2, w3, R):  # radians -> fills R (9,)
    """Rodrigues' formula, `geometry.rotation.exp`, into a row-major array."""
    angle2 = w1 * w1 + w2 * w2 + w3 * w3
    if angle2 < 1e-8:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, half = np.sin(angle) / angle, np.sin(0.5 * angle) / angle
        b = 2.0 * half * half
    R[0], R[1], R[2] = 1.0 - b * (w2 * w2 + w3 * w3), -a * w3 + b * w1 * w2, a * w2 + b * w1 * w3
    R[3], R[4], R[5] = a * w3 + b * w1 * w2, 1.0 - b * (w1 * w1 + w3 * w3), -a * w1 + b * w2 * w3
    R[6], R[7], R[8] = -a * w2 + b * w1 * w3, a * w1 + b * w2 * w3, 1.0 - b * (w1 * w1 + w2 * w2)


@njit(cache=True, nogil=True)
@no_type_check
def multiply3_numba(A, B, out):  # (9,), (9,) -> fills out (9,), which must be another array
    """out = A B for row-major 3x3 matrices."""
    for i in range(3):
        for j in range(3):
            out[3 * i + j] = A[3 * i] * B[j] + A[3 * i + 1] * B[3 + j] + A[3 * i + 2] * B[6 + j]


@njit(cache=True, nogil=True)
@no_type_check
def random_below_numba(state, n):  # (1,) uint64 -> integer in [0, n)
    """Next draw of the SplitMix64 generator, reduced to [0, n).

    The reduction prefers some numbers by at most n / 2^53, far below what sampling can notice.

    Source:
        `steele2014`.
    """
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return int((z >> np.uint64(11)) * (1.0 / 9007199254740992.0) * n)


@njit(cache=True, nogil=True)
@no_type_check
def draw_distinct_numba(state, n, count, sample):  # -> fills sample[:count]
    """`count` different integers below n, in random order; n >= count."""
    k = 0
    while k < count:
        candidate = random_below_numba(state, n)
        fresh = True
        for j in range(k):
            fresh = fresh and sample[j] != candidate
        if fresh:
            sample[k] = candidate
            k += 1
