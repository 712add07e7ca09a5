"""The lanes of `simd_numba` as tuples of float32: plain numba, for where the intrinsics cannot be built.

Slower, and not the same bits: `fma8` rounds twice.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def at(array, index):
    """As `simd_numba` says."""
    return array.reshape(-1)[index]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def prefetch(array, index):
    """As `simd_numba` says."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def load4(array, i):
    """As `simd_numba` says."""
    return array[i], array[i + 1], array[i + 2], array[i + 3]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def load8(array, i):
    """As `simd_numba` says."""
    return (
        *(array[i], array[i + 1], array[i + 2], array[i + 3]),
        *(array[i + 4], array[i + 5], array[i + 6], array[i + 7]),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def store4(array, i, v):
    """As `simd_numba` says."""
    for k in range(4):
        array[i + k] = v[k]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def store8(array, i, v):
    """As `simd_numba` says."""
    for k in range(8):
        array[i + k] = v[k]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def add8(a, b):
    """As `simd_numba` says."""
    return (
        *(a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]),
        *(a[4] + b[4], a[5] + b[5], a[6] + b[6], a[7] + b[7]),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def sub8(a, b):
    """As `simd_numba` says."""
    return (
        *(a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3]),
        *(a[4] - b[4], a[5] - b[5], a[6] - b[6], a[7] - b[7]),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def mul8(a, b):
    """As `simd_numba` says."""
    return (
        *(a[0] * b[0], a[1] * b[1], a[2] * b[2], a[3] * b[3]),
        *(a[4] * b[4], a[5] * b[5], a[6] * b[6], a[7] * b[7]),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def div8(a, b):
    """As `simd_numba` says."""
    return (
        *(a[0] / b[0], a[1] / b[1], a[2] / b[2], a[3] / b[3]),
        *(a[4] / b[4], a[5] / b[5], a[6] / b[6], a[7] / b[7]),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def fma8(a, b, c):
    """As `simd_numba` says."""
    return add8(mul8(a, b), c)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _root(x):
    return np.float32(math.sqrt(x))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def sqrt8(a):
    """As `simd_numba` says."""
    return (
        *(_root(a[0]), _root(a[1]), _root(a[2]), _root(a[3])),
        *(_root(a[4]), _root(a[5]), _root(a[6]), _root(a[7])),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _positive(x):
    return x if x > np.float32(0) else np.float32(0)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def positive8(a):
    """As `simd_numba` says."""
    return (
        *(_positive(a[0]), _positive(a[1]), _positive(a[2]), _positive(a[3])),
        *(_positive(a[4]), _positive(a[5]), _positive(a[6]), _positive(a[7])),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _chosen(test, a, b):
    return a if test != np.float32(0) else b


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def where_nonzero8(t, a, b):
    """As `simd_numba` says."""
    return (
        *(_chosen(t[0], a[0], b[0]), _chosen(t[1], a[1], b[1]), _chosen(t[2], a[2], b[2]), _chosen(t[3], a[3], b[3])),
        *(_chosen(t[4], a[4], b[4]), _chosen(t[5], a[5], b[5]), _chosen(t[6], a[6], b[6]), _chosen(t[7], a[7], b[7])),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def halves8(low, high):
    """As `simd_numba` says."""
    a, b = np.float32(low), np.float32(high)
    return a, a, a, a, b, b, b, b


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def spread8(scalar):
    """As `simd_numba` says."""
    return halves8(scalar, scalar)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def spread8_at(array, index):
    """As `simd_numba` says."""
    return spread8(array[index])


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def twice8(v):
    """As `simd_numba` says."""
    return (*v, *v)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def fold8(v):
    """As `simd_numba` says."""
    return v[0] + v[4], v[1] + v[5], v[2] + v[6], v[3] + v[7]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def first_lane(v):
    """As `simd_numba` says."""
    return v[0]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def sum8(v):
    """As `simd_numba` says."""
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
