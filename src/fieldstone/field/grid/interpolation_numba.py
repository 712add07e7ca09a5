"""Kernels on feature grids: interpolate, and move the vertices that a batch has touched.

Both vertices of a cell edge along z are neighbours in memory, so one eight-lane load fetches both with all channels.
Work on one level is split by whether the vertex has an even or odd x: every sample has two of its four edges in
either half, so two threads share the work evenly, never write to the same vertex, and add up in the same order
however many threads there are.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.field.grid.simd_numba import (
    add8,
    at,
    div8,
    first_lane,
    fma8,
    fold8,
    halves8,
    load4,
    load8,
    mul8,
    prefetch,
    spread8,
    sqrt8,
    store4,
    store8,
    sub8,
    twice8,
    where_nonzero8,
)

BLOCK = 16
"""Numbers in a block of the table, 64 bytes: what `step_touched` looks at as a whole."""

AHEAD = 6
"""How many samples ahead the next vertices are asked for."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def interpolate_point_numba(grid, x, y, z, out, start):
    """`layout.interpolate` of one point into out[start:start + 4 l]; returns the log density without its bias."""
    one = np.float32(1)
    log_density = np.float32(0)
    for level in range(grid.per_unit.shape[0]):
        scale = at(grid.per_unit, level)
        row = at(grid.sizes, level * 3 + 2) * 4
        slab = at(grid.sizes, level * 3 + 1) * row
        u, v, w = x * scale, y * scale, z * scale
        i, j, k = np.int64(u), np.int64(v), np.int64(w)
        fu, fv, fw = u - np.float32(i), v - np.float32(j), w - np.float32(k)
        b = at(grid.offsets, level) + i * slab + j * row + k * 4
        low, high = spread8(one - fv), spread8(fv)
        near = fma8(low, load8(grid.table, b), mul8(high, load8(grid.table, b + row)))
        far = fma8(low, load8(grid.table, b + slab), mul8(high, load8(grid.table, b + slab + row)))
        edges = fma8(spread8(one - fu), near, mul8(spread8(fu), far))
        value = fold8(mul8(edges, halves8(one - fw, fw)))
        store4(out, start + level * 4, value)
        log_density += first_lane(value)
    return log_density


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def prefetch_point(grid, x, y, z, level):
    """Ask for the four cell edges of a point on one level."""
    scale = at(grid.per_unit, level)
    row = at(grid.sizes, level * 3 + 2) * 4
    slab = at(grid.sizes, level * 3 + 1) * row
    b = at(grid.offsets, level) + np.int64(x * scale) * slab + np.int64(y * scale) * row + np.int64(z * scale) * 4
    prefetch(grid.table, b)
    prefetch(grid.table, b + row)
    prefetch(grid.table, b + slab)
    prefetch(grid.table, b + slab + row)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def interpolate_numba(grid, points):  # (n, 3) -> (n, 4 l)
    """`layout.interpolate` in float32."""
    width = 4 * grid.per_unit.shape[0]
    out = np.empty((points.shape[0], width), np.float32)
    flat = out.reshape(-1)
    for i in range(points.shape[0]):
        interpolate_point_numba(grid, points[i, 0], points[i, 1], points[i, 2], flat, i * width)
    return out


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _edge(grid, level, half, positions, sample):
    """Where in the table the two edges of a sample in this half start, the row length, and (weight, f_y, f_z)."""
    scale = at(grid.per_unit, level)
    row = at(grid.sizes, level * 3 + 2) * 4
    slab = at(grid.sizes, level * 3 + 1) * row
    u, v, w = (
        at(positions, sample * 3) * scale,
        at(positions, sample * 3 + 1) * scale,
        at(positions, sample * 3 + 2) * scale,
    )
    i, j, k = np.int64(u), np.int64(v), np.int64(w)
    fu, fv, fw = u - np.float32(i), v - np.float32(j), w - np.float32(k)
    other = (i ^ half) & 1
    weight = fu if other else np.float32(1) - fu
    return at(grid.offsets, level) + (i + other) * slab + j * row + k * 4, row, weight, fv, fw


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def add_gradient(grid, level, half, counts, capacity, positions, gradient, width, out, touched):
    """Add the gradient of one half (even or odd x) of one level to `out`, chunk by chunk.

    counts: samples in each chunk of `capacity`. gradient: (samples, width) flat, of the interpolated values.
    touched: one byte per block of `out`, set where something was added.
    """
    one = np.float32(1)
    for chunk in range(counts.shape[0]):
        for sample in range(chunk * capacity, chunk * capacity + counts[chunk]):
            b, row, weight, fv, fw = _edge(grid, level, half, positions, sample)
            g = mul8(halves8((one - fw) * weight, fw * weight), twice8(load4(gradient, sample * width + level * 4)))
            for _ in range(2):
                store8(out, b, fma8(spread8(one - fv), g, load8(out, b)))
                touched[b // BLOCK] = 1
                touched[(b + 4) // BLOCK] = 1
                b += row
                fv = one - fv


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def step_touched(table, mean_square, gradient, touched, first, last, rates, decay_factors, decay, epsilon):
    """One RMSprop step of the values with a gradient in blocks `first` to `last` (multiples of 8); clears both.

    v <- decay v + (1 - decay) g^2,   p <- factor p - rate g / (sqrt(v) + epsilon).

    rates, decay_factors: (8,) by channel, twice. Values that no sample touched keep p and v: a vertex that is seen
    once in a hundred batches must not drift in between.

    Source:
        `tieleman2012`; the factor is the weight decay of `loshchilov2019`, algorithm 2. Departure: no step where the
        gradient is exactly 0.
    """
    zero, memory, new, tiny = spread8(0), spread8(decay), spread8(np.float32(1) - decay), spread8(epsilon)
    rate, factor = load8(rates, 0), load8(decay_factors, 0)
    blocks = np.empty(last - first + AHEAD, np.int64)
    count = 0
    words = touched.view(np.uint64)
    for word in range(first // 8, last // 8):
        if at(words, word) != 0:
            for block in range(word * 8, word * 8 + 8):
                blocks[count] = block * BLOCK
                count += np.int64(at(touched, block) != 0)
            words[word] = 0
    blocks[count : count + AHEAD] = 0
    for n in range(count):
        ahead = at(blocks, n + AHEAD)
        prefetch(table, ahead)
        prefetch(mean_square, ahead)
        prefetch(gradient, ahead)
        for part in range(2):
            i = at(blocks, n) + part * 8
            g, v, p = load8(gradient, i), load8(mean_square, i), load8(table, i)
            v_new = fma8(memory, v, mul8(new, mul8(g, g)))
            p_new = sub8(mul8(factor, p), div8(mul8(rate, g), add8(sqrt8(v_new), tiny)))
            store8(mean_square, i, where_nonzero8(g, v_new, v))
            store8(table, i, where_nonzero8(g, p_new, p))
            store8(gradient, i, zero)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def step_by_sample(
    grid, level, half, counts, capacity, positions, gradient, width, mean_square, rates, decay_factors, decay, epsilon
):
    """The step of `step_touched` for every sample at once, without a gradient table, on one half of one level.

    On the finest level hardly two samples of a batch meet in a vertex, and what costs is memory: this reads and
    writes value and mean square of 32 bytes per edge where the two-pass way also fills, reads and clears a gradient.
    """
    one = np.float32(1)
    memory, new, tiny = spread8(decay), spread8(one - decay), spread8(epsilon)
    rate, factor = load8(rates, 0), load8(decay_factors, 0)
    for chunk in range(counts.shape[0]):
        end = chunk * capacity + counts[chunk]
        for sample in range(chunk * capacity, end):
            b, row, weight, fv, fw = _edge(grid, level, half, positions, min(sample + AHEAD, end - 1))
            prefetch(grid.table, b)
            prefetch(grid.table, b + row)
            prefetch(mean_square, b)
            prefetch(mean_square, b + row)
            b, row, weight, fv, fw = _edge(grid, level, half, positions, sample)
            shared = mul8(
                halves8((one - fw) * weight, fw * weight), twice8(load4(gradient, sample * width + level * 4))
            )
            for _ in range(2):
                g = mul8(spread8(one - fv), shared)
                v = fma8(memory, load8(mean_square, b), mul8(new, mul8(g, g)))
                store8(mean_square, b, v)
                p = mul8(factor, load8(grid.table, b))
                store8(grid.table, b, sub8(p, div8(mul8(rate, g), add8(sqrt8(v), tiny))))
                b += row
                fv = one - fv
