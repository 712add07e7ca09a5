"""The scale space of a photo, one octave at a time, and its extrema.

An octave is six images of one size, each more blurred than the one before by a factor of 2^(1/3), and the five
differences between them. That of a photo of a megapixel has three million pixels in each, so all images are made in
one pass from top to bottom, in which each follows the one before by as many rows as its blur reaches: what it needs is
in the cache. Only the three images in which features are described are kept whole.

Source:
    `lowe2004`, sections 3 and 4.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fieldstone.features.blur_numba import KERNEL, blur_row_numba, gaussian_weights, row_numba

LAYERS = 3
"""Layers per octave in which extrema are found."""
SIGMA = 1.6
"""Blur of the first image of an octave, in its pixels."""
BORDER = 5
"""Extrema lie so many pixels away from the border of an octave, or more."""
MAX_STEPS = 5
"""So often an extremum may be looked for at a neighbour of where it seemed to be."""
MARGIN = np.float32(0.5)
"""An extremum between pixels may exceed what they show: they are searched down to this share of the least contrast."""

IMAGE_RING = 32
"""Rows that are kept of an image that is not kept whole."""
DIFFERENCE_RING = 16
"""Rows that are kept of the differences: more than `MAX_STEPS` and a neighbour on either side of the one searched."""


def octave_weights() -> tuple[Float[np.ndarray, "6 _"], Int[np.ndarray, "6"]]:
    """The weights that make each image of an octave from the one before, filled up with zeros, and their radii."""
    growth = 2.0 ** (1.0 / LAYERS)
    steps = [SIGMA * growth ** (s - 1) * np.sqrt(growth**2 - 1.0) for s in range(1, LAYERS + 3)]
    each = [np.zeros(1, dtype=np.float32), *map(gaussian_weights, steps)]
    radii = np.array([len(weights) - 1 for weights in each])
    return np.stack([np.pad(weights, (0, radii.max() - len(weights) + 1)) for weights in each]), radii


def empty_levels(first: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "_ _"], ...]:
    """The images of an octave: the first, room for those that keypoints are described in, and for rows of two more."""
    h, w = first.shape
    rows = [h] * LAYERS + [min(h, IMAGE_RING)] * 2
    return (first, *(np.empty((n, w), dtype=np.float32) for n in rows))


@njit(**KERNEL)
@no_type_check
def octave_extrema_numba(levels, weights, radii, least_contrast, max_edge_ratio):
    """Fill the images of an octave from its first, and find the extrema of their differences.

    levels: see `empty_levels`;  weights, radii: see `octave_weights`;  -> (n, 4): x, y, level, contrast. Whole numbers
    are the centres of pixels, and the images. An extremum that several pixels lead to is there several times.
    """
    h, w = levels[0].shape
    # An int64 from the start, or numba would compile what it goes into once more.
    found, n = np.empty((256, 4), np.float64), np.int64(0)
    line, marks = np.empty(w + 2 * weights.shape[1], np.float32), np.zeros((w + 7) // 8 * 8, np.uint8)
    differences = np.zeros((LAYERS + 2, DIFFERENCE_RING, w), np.float32)
    for step in range(h + radii[2:].sum() + MAX_STEPS + 1):
        y = step + radii[1]
        for s in range(1, LAYERS + 3):
            y -= radii[s]
            if 0 <= y < h:
                blur_row_numba(levels[s - 1], levels[s], y, h, weights[s, : radii[s] + 1], line)
        if 0 <= y < h:
            for s in range(LAYERS + 2):
                more, less = row_numba(levels[s + 1], y, h), row_numba(levels[s], y, h)
                _subtract(differences[s, y % DIFFERENCE_RING], more, less)
        y -= MAX_STEPS + 1
        if BORDER <= y < h - BORDER:
            for s in range(1, LAYERS + 1):
                _mark_row(differences, s, y, MARGIN * least_contrast, marks)
                found, n = _enter_row(differences, h, s, y, marks, least_contrast, max_edge_ratio, found, n)
    return found[:n]


@njit(**KERNEL, forceinline=True)
@no_type_check
def _subtract(out, a, b):
    """All (w,)"""
    for x in range(out.shape[0]):
        out[x] = a[x] - b[x]


@njit(**KERNEL)
@no_type_check
def _mark_row(differences, s, y, least, marks):
    """Mark the pixels of a row that may be extrema.  differences (5, rows, w);  marks (w or more,) uint8"""
    stop = differences.shape[2] - BORDER
    row, up, down = y % DIFFERENCE_RING, (y - 1) % DIFFERENCE_RING, (y + 1) % DIFFERENCE_RING
    _mark(
        marks[BORDER:stop],
        differences[s, row, BORDER:stop],
        differences[s, row, BORDER - 1 : stop - 1],
        differences[s, row, BORDER + 1 : stop + 1],
        differences[s, up, BORDER:stop],
        differences[s, down, BORDER:stop],
        differences[s - 1, row, BORDER:stop],
        differences[s + 1, row, BORDER:stop],
        least,
    )


@njit(**KERNEL, forceinline=True)
@no_type_check
def _mark(marks, here, left, right, up, down, below, above, least):
    """1 where a value is large, or small, and not exceeded by the nearest six in space and scale; else 0.  All (w,)"""
    for x in range(here.shape[0]):
        v, a, b, c, d, e, f = here[x], left[x], right[x], up[x], down[x], below[x], above[x]
        high = (v > least) & (v >= a) & (v >= b) & (v >= c) & (v >= d) & (v >= e) & (v >= f)
        low = (v < -least) & (v <= a) & (v <= b) & (v <= c) & (v <= d) & (v <= e) & (v <= f)
        marks[x] = np.uint8(high | low)


@njit(**KERNEL)
@no_type_check
def _enter_row(differences, height, s, y, marks, least_contrast, max_edge_ratio, found, n):
    """Enter the extrema among the marked pixels.  found (capacity, 4), of which n are filled; returned enlarged"""
    eights, cube = marks.view(np.uint64), np.empty((3, 3, 3), np.float64)
    for k in range(eights.shape[0]):
        if eights[k] == 0:
            continue
        for x in range(8 * k, 8 * k + 8):
            if marks[x] != 0 and _is_extremum(differences, s, y, x):
                if n == found.shape[0]:
                    found = np.concatenate((found, np.empty_like(found)))
                if _refine(differences, height, s, y, x, least_contrast, max_edge_ratio, cube, found[n]):
                    n += 1
    return found, n


@njit(**KERNEL)
@no_type_check
def _is_extremum(differences, s, y, x):
    """Whether none of its 26 neighbours in space and scale exceeds a value on its side of zero."""
    value = differences[s, y % DIFFERENCE_RING, x]
    sign = np.float32(1.0) if value > 0 else np.float32(-1.0)
    for k in range(s - 1, s + 2):
        for j in range(y - 1, y + 2):
            for i in range(x - 1, x + 2):
                if sign * differences[k, j % DIFFERENCE_RING, i] > sign * value:
                    return False
    return True


@njit(**KERNEL)
@no_type_check
def _refine(differences, height, s, y, x, least_contrast, max_edge_ratio, cube, out):
    """Find the extremum of the parabola about a pixel, or about a neighbour if it lies there.

    cube (3, 3, 3): room to work in;  out (4,): see `octave_extrema_numba`.

    With the gradient g and the second derivatives H in (x, y, s):  offset = -H^-1 g,  value = D + g . offset / 2.
    It is left out if its contrast |value| is too small, or if it lies along an edge: for a ratio r of curvatures
    tr(H)^2 / det(H), of x and y alone, is (r + 1)^2 / r.

    Returns:
        Whether there is one.

    Source:
        `lowe2004`, sections 4 and 4.1.
    """
    w = differences.shape[2]
    for _ in range(MAX_STEPS):
        _copy_neighbours(differences, s, y, x, cube)
        gx, gy, gs, xx, yy, ss, xy, xs, ys = _derivatives(cube)
        # The adjugate of H, which is symmetric.
        a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
        d, e, f = xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy
        det = xx * a + xy * b + xs * c
        dx, dy, ds = -(a * gx + b * gy + c * gs), -(b * gx + d * gy + e * gs), -(c * gx + e * gy + f * gs)
        if not max(abs(dx), abs(dy), abs(ds)) < max(height, w) * abs(det):
            return False
        dx, dy, ds = dx / det, dy / det, ds / det
        if max(abs(dx), abs(dy), abs(ds)) < 0.5:
            contrast = abs(cube[1, 1, 1] + 0.5 * (gx * dx + gy * dy + gs * ds))
            out[0], out[1], out[2], out[3] = x + dx, y + dy, s + ds, contrast
            edge = (xx + yy) ** 2 * max_edge_ratio >= (max_edge_ratio + 1.0) ** 2 * f
            return contrast >= least_contrast and not edge
        x, y, s = x + round(dx), y + round(dy), s + round(ds)
        if not (1 <= s <= LAYERS and BORDER <= x < w - BORDER and BORDER <= y < height - BORDER):
            return False
    return False


@njit(**KERNEL)
@no_type_check
def _copy_neighbours(differences, s, y, x, cube):
    """The values about a pixel, in float64, in which their differences are exact.  cube (3, 3, 3): s, y, x"""
    for k in range(3):
        for j in range(3):
            row = differences[s + k - 1, (y + j - 1) % DIFFERENCE_RING]
            for i in range(3):
                cube[k, j, i] = row[x + i - 1]


@njit(**KERNEL)
@no_type_check
def _derivatives(cube):
    """Central differences: first along x, y, s, then xx, yy, ss, xy, xs, ys.  cube (3, 3, 3): s, y, x"""
    gx, gy, gs = cube[1, 1, 2] - cube[1, 1, 0], cube[1, 2, 1] - cube[1, 0, 1], cube[2, 1, 1] - cube[0, 1, 1]
    twice = 2.0 * cube[1, 1, 1]
    xx = cube[1, 1, 2] + cube[1, 1, 0] - twice
    yy = cube[1, 2, 1] + cube[1, 0, 1] - twice
    ss = cube[2, 1, 1] + cube[0, 1, 1] - twice
    xy = cube[1, 2, 2] - cube[1, 2, 0] - cube[1, 0, 2] + cube[1, 0, 0]
    xs = cube[2, 1, 2] - cube[2, 1, 0] - cube[0, 1, 2] + cube[0, 1, 0]
    ys = cube[2, 2, 1] - cube[2, 0, 1] - cube[0, 2, 1] + cube[0, 0, 1]
    return 0.5 * gx, 0.5 * gy, 0.5 * gs, xx, yy, ss, 0.25 * xy, 0.25 * xs, 0.25 * ys
