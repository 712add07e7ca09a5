"""Orientations and descriptors of keypoints, from the images of an octave.

Both look at a square about the keypoint that is sampled anew: turned with the keypoint, and in steps of 3/4 of its
scale. An image that is blurred by the scale has no detail that such steps would miss, and there are a third to an
eighth as many of them as pixels. Where samples lie in the grid of cells, and what they weigh, is then the same for all
keypoints.

Source:
    `lowe2004`, sections 5 and 6; `arandjelovic2012`, section 3. Departure: samples in steps of the scale.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.features.blur_numba import KERNEL
from fieldstone.features.scale_space_numba import LAYERS, SIGMA

STEP = 0.75
"""Between samples, in units of the keypoint's scale."""

ORIENTATION_BINS = 36
ORIENTATION_SIDE = 15
"""Samples per side of the square that gives orientations: 13 with a gradient, out to 4.5 times the scale."""
ORIENTATION_SIGMA = 1.5
"""Of the weights of orientations, in units of the keypoint's scale."""
PEAK = np.float32(0.8)
"""Bins that reach this share of the highest, and exceed their neighbours, give orientations."""
MAX_ORIENTATIONS = ORIENTATION_BINS // 2

CELLS = 4
"""Cells of a descriptor per side."""
SAMPLES_PER_CELL = 4
"""Per side; so a cell is three times the scale wide."""
DIRECTIONS = 8
GRID = (CELLS + 1) * SAMPLES_PER_CELL
"""Samples per side that have a share in a cell: half a cell beyond the outer ones."""
DESCRIPTOR_SIDE = GRID + 2
"""And neighbours for their gradients."""
PADDED = CELLS + 2
DESCRIPTOR_SIZE = CELLS * CELLS * DIRECTIONS
MAX_SHARE = np.float32(0.2)
"""No value of a descriptor exceeds this share of its length: one strong edge is not all of it."""
DESCRIPTOR_SCALE = 512.0
"""RootSIFT descriptors have unit length; as uint8 they are multiplied by this and clipped at 255."""

ZERO, HALF, NEXT = np.float32(0.0), np.float32(0.5), np.uint64(1)
QUARTER_TURN, HALF_TURN = np.float32(pi / 2), np.float32(pi)
TINY, SCALE, LARGEST = np.float32(1e-20), np.float32(DESCRIPTOR_SCALE), np.float32(255.0)
ARC_TANGENT = tuple(map(np.float32, (0.9999772, -0.3326228, 0.1935404, -0.1164264, 0.0526473, -0.0117191)))
"""Coefficients of the arc tangent of 0 to 1, which is off by 2e-6 at most."""
BINS_PER_RADIAN = np.float32(ORIENTATION_BINS / (2 * pi))
DIRECTIONS_PER_RADIAN = np.float32(DIRECTIONS / (2 * pi))


def orientation_weights() -> Float[np.ndarray, "_"]:
    """A Gaussian at the samples, row by row; zero at the border, where there are no gradients."""
    at = (np.arange(ORIENTATION_SIDE) - (ORIENTATION_SIDE - 1) / 2) * STEP
    along = np.exp(-(at**2) / (2 * ORIENTATION_SIGMA**2))
    along[[0, -1]] = 0.0
    return np.outer(along, along).ravel().astype(np.float32)


def cell_weights() -> Float[np.ndarray, "20 2"]:
    """What each row (or column) of samples gives to the two rows of cells whose middles it lies between.

    Linear in the distance to the middle of the cell, times a Gaussian of half the descriptor's width.
    """
    from_centre = (np.arange(GRID) + 0.5) / SAMPLES_PER_CELL - (CELLS + 1) / 2
    from_middle = (np.arange(GRID) % SAMPLES_PER_CELL + 0.5) / SAMPLES_PER_CELL
    gaussian = np.exp(-(from_centre**2) / (2 * (CELLS / 2) ** 2))
    return (np.stack([1.0 - from_middle, from_middle], axis=1) * gaussian[:, None]).astype(np.float32)


def sample_grid(side: int) -> Float[np.ndarray, "2 _"]:
    """(x, y) of the samples of a square, row by row, in steps from its middle."""
    along = (np.arange(side) - 0.5 * (side - 1)).astype(np.float32)
    return np.stack([np.tile(along, side), np.repeat(along, side)])


@njit(**KERNEL)
@no_type_check
def orientations_numba(levels, keypoints, grid, weights, angles):
    """The orientations of keypoints.

    levels: images 1 to 3 of an octave (h, w);  keypoints (n, 4): see `octave_extrema_numba`;  grid: see
    `sample_grid`;  weights: see `orientation_weights`;  angles (n, 18), to be filled: radians from x towards y;
    -> how many of each (n,)
    """
    count = np.zeros(keypoints.shape[0], np.int64)
    size = grid.shape[1]
    patch, length, direction = np.empty(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
    pixel, fraction = np.empty(size, np.int32), np.empty((2, size), np.float32)
    histogram = np.empty(ORIENTATION_BINS, np.float32)
    for k in range(keypoints.shape[0]):
        x, y, level = keypoints[k, 0], keypoints[k, 1], keypoints[k, 2]
        step = STEP * SIGMA * 2.0 ** (level / LAYERS)
        _sample(levels[round(level) - 1], x, y, step, 0.0, grid, pixel, fraction, patch)
        _gradients(patch, ORIENTATION_SIDE, BINS_PER_RADIAN, np.float32(ORIENTATION_BINS), length, direction)
        histogram[:] = ZERO
        for i in range(size):
            below = int(direction[i])
            value = weights[i] * length[i]
            above = value * (direction[i] - np.float32(below))
            histogram[below % ORIENTATION_BINS] += value - above
            histogram[(below + 1) % ORIENTATION_BINS] += above
        count[k] = _peaks(histogram, angles[k])
    return count


@njit(**KERNEL)
@no_type_check
def _peaks(histogram, angles):
    """Angles of the high local maxima of a smoothed cyclic histogram; -> how many.  histogram (36,)"""
    n = ORIENTATION_BINS
    smooth = np.empty(n, np.float32)
    for k in range(n):
        near, far = histogram[k - 1] + histogram[(k + 1) % n], histogram[k - 2] + histogram[(k + 2) % n]
        smooth[k] = np.float32(6.0) * histogram[k] + np.float32(4.0) * near + far
    least, count = PEAK * smooth.max(), 0
    for k in range(n):
        left, value, right = smooth[k - 1], smooth[k], smooth[(k + 1) % n]
        if value > left and value > right and value >= least:
            # The top of the parabola through the three.
            angles[count] = (k + HALF * (left - right) / (left - value - value + right)) * (2.0 * pi / n) % (2.0 * pi)
            count += 1
    return count


@njit(**KERNEL)
@no_type_check
def descriptors_numba(levels, keypoints, angles, grid, weights):
    """RootSIFT descriptors.

    levels, keypoints, grid: see `orientations_numba`;  angles (n,);  weights: see `cell_weights`;  -> (n, 128) uint8
    """
    out = np.empty((keypoints.shape[0], DESCRIPTOR_SIZE), np.uint8)
    size = grid.shape[1]
    patch, length, direction = np.empty(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
    pixel, fraction = np.empty(size, np.int32), np.empty((2, size), np.float32)
    # One cell more on every side takes what lies beyond, and is left out.
    cells, of_row = np.empty((PADDED, PADDED * DIRECTIONS), np.float32), np.empty(PADDED * DIRECTIONS, np.float32)
    for k in range(keypoints.shape[0]):
        x, y, level = keypoints[k, 0], keypoints[k, 1], keypoints[k, 2]
        step = STEP * SIGMA * 2.0 ** (level / LAYERS)
        _sample(levels[round(level) - 1], x, y, step, angles[k], grid, pixel, fraction, patch)
        _gradients(patch, DESCRIPTOR_SIDE, DIRECTIONS_PER_RADIAN, np.float32(DIRECTIONS), length, direction)
        cells[:] = ZERO
        for j in range(GRID):
            _collect_row(length, direction, j, weights, of_row)
            cell = j // SAMPLES_PER_CELL
            for i in range(PADDED * DIRECTIONS):
                cells[cell, i] += weights[j, 0] * of_row[i]
                cells[cell + 1, i] += weights[j, 1] * of_row[i]
        _quantise(cells[1 : 1 + CELLS, DIRECTIONS : DIRECTIONS + CELLS * DIRECTIONS].copy().reshape(-1), out[k])
    return out


@njit(**KERNEL)
@no_type_check
def _collect_row(length, direction, j, weights, of_row):
    """Gradients of row j of samples by column of cells and direction, linearly between the middles of either.

    length, direction (22 * 22,);  weights (20, 2);  of_row (6 * 8,), to be filled
    """
    of_row[:] = ZERO
    for i in range(GRID):
        at = (j + 1) * DESCRIPTOR_SIDE + i + 1
        whole = int(direction[at])
        after = length[at] * (direction[at] - np.float32(whole))
        before = length[at] - after
        # Counter-clockwise, as seen by the reader: the custom of other SIFTs.
        first = i // SAMPLES_PER_CELL * DIRECTIONS + (-whole) % DIRECTIONS
        second = i // SAMPLES_PER_CELL * DIRECTIONS + (-whole - 1) % DIRECTIONS
        of_row[first] += weights[i, 0] * before
        of_row[second] += weights[i, 0] * after
        of_row[first + DIRECTIONS] += weights[i, 1] * before
        of_row[second + DIRECTIONS] += weights[i, 1] * after


@njit(**KERNEL)
@no_type_check
def _quantise(values, out):
    """Square roots of the shares of a descriptor, its largest values cut off, times 512.  (128,) -> (128,) uint8"""
    squares = ZERO
    for value in values:
        squares += value * value
    largest, total = MAX_SHARE * np.sqrt(squares), TINY
    for k in range(values.shape[0]):
        values[k] = min(values[k], largest)
        total += values[k]
    for k in range(values.shape[0]):
        out[k] = np.uint8(min(SCALE * np.sqrt(values[k] / total) + HALF, LARGEST))


@njit(**KERNEL)
@no_type_check
def _sample(image, x, y, step, angle, grid, pixel, fraction, patch):
    """A square of samples about (x, y), its rows along the angle, bilinear; beyond the border as at it.

    image (h, w), h and w at least 2;  grid: see `sample_grid`;  pixel (size,) int32, fraction (2, size): room to work
    in;  patch (size,), to be filled
    """
    h, w = image.shape
    c, s = np.float32(step * cos(angle)), np.float32(step * sin(angle))
    x, y, right, bottom, stride = np.float32(x), np.float32(y), np.float32(w - 1), np.float32(h - 1), np.int32(w)
    last_column, last_row = np.int32(w - 2), np.int32(h - 2)
    for k in range(patch.shape[0]):
        px = min(max(x + c * grid[0, k] - s * grid[1, k], ZERO), right)
        py = min(max(y + s * grid[0, k] + c * grid[1, k], ZERO), bottom)
        column, row = min(np.int32(px), last_column), min(np.int32(py), last_row)
        fraction[0, k], fraction[1, k] = px - np.float32(column), py - np.float32(row)
        pixel[k] = row * stride + column
    # Unsigned, for an index that may be negative is looked at before it is used.
    values, next_row = image.reshape(-1), np.uint64(w)
    for k in range(patch.shape[0]):
        at = np.uint64(pixel[k])
        a, b = values[at], values[at + next_row]
        above = a + fraction[0, k] * (values[at + NEXT] - a)
        below = b + fraction[0, k] * (values[at + next_row + NEXT] - b)
        patch[k] = above + fraction[1, k] * (below - above)


@njit(**KERNEL)
@no_type_check
def _gradients(patch, side, bins_per_radian, bins, length, direction):
    """Lengths and directions, in bins from 0 up to all of them, of the gradients of a square of samples.

    All (side * side,). As one row, since short rows would not fill the lanes: what is found at the border is no
    gradient, and the first and the last row are left as they are.
    """
    n = side * side - 2 * side
    dx_from, dx_to = patch[side - 1 :][:n], patch[side + 1 :][:n]
    dy_from, dy_to = patch[:n], patch[2 * side :][:n]
    _polar(dx_from, dx_to, dy_from, dy_to, bins_per_radian, bins, length[side:][:n], direction[side:][:n])


@njit(**KERNEL, forceinline=True)
@no_type_check
def _polar(dx_from, dx_to, dy_from, dy_to, bins_per_radian, bins, length, direction):
    """Length and direction of (dx, dy), all (n,), without a branch."""
    for k in range(length.shape[0]):
        dx, dy = dx_to[k] - dx_from[k], dy_to[k] - dy_from[k]
        ax, ay = abs(dx), abs(dy)
        ratio = min(ax, ay) / max(max(ax, ay), TINY)
        angle = _arc_tangent(ratio)
        angle = QUARTER_TURN - angle if ay > ax else angle
        angle = HALF_TURN - angle if dx < ZERO else angle
        turns = bins_per_radian * angle
        length[k] = np.sqrt(dx * dx + dy * dy)
        direction[k] = bins - turns if dy < ZERO else turns


@njit(**KERNEL, forceinline=True)
@no_type_check
def _arc_tangent(ratio):
    """Of 0 to 1, as the odd polynomial of degree 11 whose largest error is least."""
    square = ratio * ratio
    high = ARC_TANGENT[3] + square * (ARC_TANGENT[4] + square * ARC_TANGENT[5])
    return ratio * (ARC_TANGENT[0] + square * (ARC_TANGENT[1] + square * (ARC_TANGENT[2] + square * high)))
