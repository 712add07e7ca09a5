"""Gaussian blur of float32 images, one row at a time.

A row needs r + 1 products and 2 r sums per pixel and direction. Eight pixels go through one instruction, so what is
added to must not be read and written for every one of them: pairs of pixels at equal distances come four at a time.

The order of sums is as written, so results depend on neither the number of threads nor the run.
"""

from __future__ import annotations

from math import ceil
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

REACH = 4.0
"""Standard deviations at which the weights of a blur end, but for one pixel."""

KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}


def gaussian_weights(sigma: float) -> Float[np.ndarray, "r"]:
    """Weights of the pixels at distances 0, 1, ..., r on either side, r = 2, 6, 10, ...; all 2 r + 1 add up to one."""
    radius = 2 + 4 * max(0, ceil((REACH * sigma - 3.0) / 4))
    weights = np.exp(-(np.arange(radius + 1) ** 2) / (2.0 * sigma**2))
    return (weights / (2.0 * weights.sum() - weights[0])).astype(np.float32)


@njit(**KERNEL)
@no_type_check
def blurred_numba(image, weights):
    """The image blurred.  (h, w) float32 -> (h, w)"""
    h, w = image.shape
    out, line = np.empty((h, w), np.float32), np.empty(w + 2 * weights.shape[0], np.float32)
    for y in range(h):
        blur_row_numba(image, out, y, h, weights, line)
    return out


@njit(**KERNEL)
@no_type_check
def blur_row_numba(source, target, y, height, weights, line):
    """Row y of the blurred image: across rows into `line`, then along it.

    source, target (rows, w): row y of an image of which the last rows are kept is y % rows;  line (w + 2 r or more,)
    """
    r, w = weights.shape[0] - 1, source.shape[1]
    middle = line[r : r + w]
    a1, b1 = row_numba(source, y - 1, height), row_numba(source, y + 1, height)
    a2, b2 = row_numba(source, y - 2, height), row_numba(source, y + 2, height)
    _begin(middle, row_numba(source, y, height), a1, b1, a2, b2, weights)
    for t in range(3, r, 4):
        a1, b1 = row_numba(source, y - t, height), row_numba(source, y + t, height)
        a2, b2 = row_numba(source, y - t - 1, height), row_numba(source, y + t + 1, height)
        a3, b3 = row_numba(source, y - t - 2, height), row_numba(source, y + t + 2, height)
        a4, b4 = row_numba(source, y - t - 3, height), row_numba(source, y + t + 3, height)
        _add(middle, a1, b1, a2, b2, a3, b3, a4, b4, weights[t : t + 4])
    for t in range(1, r + 1):
        line[r - t] = middle[mirrored_numba(-t, w)]
        line[r + w - 1 + t] = middle[mirrored_numba(w - 1 + t, w)]
    _blur_line(line, target[y % target.shape[0]], weights)


@njit(**KERNEL, forceinline=True)
@no_type_check
def _blur_line(line, out, weights):
    """Along a line that goes on r pixels beyond either border.  line (w + 2 r or more,);  out (w,)"""
    r, w = weights.shape[0] - 1, out.shape[0]
    a1, b1, a2, b2 = line[r - 1 :][:w], line[r + 1 :][:w], line[r - 2 :][:w], line[r + 2 :][:w]
    _begin(out, line[r:][:w], a1, b1, a2, b2, weights)
    for t in range(3, r, 4):
        a, b = r - t, r + t
        a1, b1, a2, b2 = line[a:][:w], line[b:][:w], line[a - 1 :][:w], line[b + 1 :][:w]
        a3, b3, a4, b4 = line[a - 2 :][:w], line[b + 2 :][:w], line[a - 3 :][:w], line[b + 3 :][:w]
        _add(out, a1, b1, a2, b2, a3, b3, a4, b4, weights[t : t + 4])


@njit(**KERNEL, forceinline=True)
@no_type_check
def _begin(out, c, a1, b1, a2, b2, weights):
    """The middle and the two nearest pairs.  All but the weights (w,)"""
    w0, w1, w2 = weights[0], weights[1], weights[2]
    for x in range(out.shape[0]):
        out[x] = w0 * c[x] + w1 * (a1[x] + b1[x]) + w2 * (a2[x] + b2[x])


@njit(**KERNEL, forceinline=True)
@no_type_check
def _add(out, a1, b1, a2, b2, a3, b3, a4, b4, weights):
    """Four pairs more.  All but the weights (w,)"""
    w1, w2, w3, w4 = weights[0], weights[1], weights[2], weights[3]
    for x in range(out.shape[0]):
        near = w1 * (a1[x] + b1[x]) + w2 * (a2[x] + b2[x])
        out[x] += near + (w3 * (a3[x] + b3[x]) + w4 * (a4[x] + b4[x]))


@njit(**KERNEL, forceinline=True)
@no_type_check
def row_numba(image, y, height):
    """Row y, which may lie beyond the border, of an image of which the last rows are kept.  (rows, w) -> (w,)"""
    return image[mirrored_numba(y, height) % image.shape[0]]


@njit(**KERNEL)
@no_type_check
def mirrored_numba(k, n):
    """Index of what is seen at k in mirrors at the centres of the first and the last of n pixels."""
    if n == 1:
        return 0
    k = abs(k) % (2 * n - 2)
    return min(k, 2 * n - 2 - k)
