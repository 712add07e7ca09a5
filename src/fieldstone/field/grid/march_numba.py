"""Kernels that walk rays through a grid field: where there is something, what weighs, and how the loss pulls at it.

Samples lie `step` apart. Empty cells are jumped over by a grid of distances to the nearest occupied cell. Positions
are queued a few samples ahead, so that their vertices are on the way from memory when they are asked for.
"""

from __future__ import annotations

import math
from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from fieldstone.field.base.space import CONTRACTED, Space
from fieldstone.field.base.space_numba import contract_numba
from fieldstone.field.grid.interpolation_numba import interpolate_point_numba, prefetch_point
from fieldstone.field.grid.simd_numba import at

QUEUE = 4
"""Samples between asking for vertices and using them; a power of two."""

MIN_LOG_DENSITY, MAX_LOG_DENSITY = np.float32(-7.0), np.float32(10.0)
"""Below, a sample is empty; above, it is as dense as it gets."""


class Box(NamedTuple):
    """Where there is something; coordinates are those of the grid, relative to the lower corner."""

    lower: np.ndarray
    extent: np.ndarray
    distance: np.ndarray
    """uint8, flat: cells to the nearest occupied one, by the largest coordinate difference; 0 where occupied.

    In bricks of 4 x 4 x 4 cells, 64 bytes each: what a ray asks for next is mostly in the same cache line.
    """
    cells: np.ndarray
    """int64 (3)."""
    cell_size: np.float32
    space: Space


class March(NamedTuple):
    """How rays are sampled."""

    step: np.float32
    density_bias: np.float32
    """Log density of an untouched grid; the density is exp(density_bias + sum of the levels)."""
    depth_scale: np.float32
    """Optical depth of one step at density 1."""
    min_weight: np.float32
    """Samples that give less to the pixel than this are left out."""
    early_stop_eps: np.float32
    """A ray ends where less light than this is left."""
    near: np.float32
    """Where rays begin: nothing can be learned of what is nearer."""


class Samples(NamedTuple):
    """What weighs along a batch of rays, ray by ray; flat arrays with room for `capacity` samples."""

    position: np.ndarray
    distance: np.ndarray
    alpha: np.ndarray
    tau: np.ndarray
    transmittance: np.ndarray
    """T, the light that reaches the sample."""
    ray: np.ndarray
    features: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def distance_at(box, i, j, k):
    """`Box.distance` of cell i, j, k."""
    bricks_y, bricks_z = (at(box.cells, 1) + 3) >> 2, (at(box.cells, 2) + 3) >> 2
    brick = ((i >> 2) * bricks_y + (j >> 2)) * bricks_z + (k >> 2)
    return np.int64(at(box.distance, (brick << 6) | ((i & 3) << 4) | ((j & 3) << 2) | (k & 3)))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def cut_to_slab(o, d, low, high, t0, t1):
    """Cut [t0, t1] to where o + t d lies in [low, high]."""
    if abs(d) < np.float32(1e-9):
        return (t0, t1) if low <= o <= high else (t1, t0)
    a, b = (low - o) / d, (high - o) / d
    return max(t0, min(a, b)), min(t1, max(a, b))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def steps_out_of_cell(box, step, distance, i, j, k, x, y, z, dx, dy, dz):
    """Steps from a point until the ray leaves the empty cube of `distance` - 1 cells around its cell."""
    tiny, cell = np.float32(1e-9), box.cell_size
    ahead = np.float32(1e30)
    if abs(dx) > tiny:
        ahead = min(ahead, (np.float32(i + distance if dx > 0 else i - distance + 1) * cell - x) / dx)
    if abs(dy) > tiny:
        ahead = min(ahead, (np.float32(j + distance if dy > 0 else j - distance + 1) * cell - y) / dy)
    if abs(dz) > tiny:
        ahead = min(ahead, (np.float32(k + distance if dz > 0 else k - distance + 1) * cell - z) / dz)
    return np.float32(max(np.int64(ahead / step) + 1, 1))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def march_ray(
    grid, box, march, contracted, half_side, origins, directions, ray, jitter, far, n, capacity, width, out, queue
):
    """Append the samples of one ray behind the n there are; returns (n, transmittance, density evaluations).

    jitter: fraction of a step before the first sample. far: where the ray ends at the latest.
    """
    zero, one = np.float32(0), np.float32(1)
    dx, dy, dz = at(directions, ray * 3), at(directions, ray * 3 + 1), at(directions, ray * 3 + 2)
    ex, ey, ez = at(box.extent, 0), at(box.extent, 1), at(box.extent, 2)
    ox, oy, oz = (
        at(origins, ray * 3) - at(box.lower, 0),
        at(origins, ray * 3 + 1) - at(box.lower, 1),
        at(origins, ray * 3 + 2) - at(box.lower, 2),
    )
    t, t_end = march.near, np.float32(far)
    if not contracted:
        t, t_end = cut_to_slab(ox, dx, zero, ex, t, t_end)
        t, t_end = cut_to_slab(oy, dy, zero, ey, t, t_end)
        t, t_end = cut_to_slab(oz, dz, zero, ez, t, t_end)
    transmittance = one
    if not dx * dx + dy * dy + dz * dz > zero:  # nan, outside of a lens: it would never leave the box
        return n, transmittance, 0
    t += jitter * march.step
    nx, ny, nz = at(box.cells, 0), at(box.cells, 1), at(box.cells, 2)
    per_cell = one / box.cell_size
    finest = grid.per_unit.shape[0] - 1
    evaluations, head, tail = 0, 0, 0
    while True:
        while t < t_end and tail - head < QUEUE:
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            stride = march.step
            if contracted:
                x, y, z, reach = contract_numba(x, y, z, half_side)
                stride = march.step * reach * reach
            x, y, z = min(max(x, zero), ex), min(max(y, zero), ey), min(max(z, zero), ez)
            i, j, k = (
                min(np.int64(x * per_cell), nx - 1),
                min(np.int64(y * per_cell), ny - 1),
                min(np.int64(z * per_cell), nz - 1),
            )
            distance = distance_at(box, i, j, k)
            if distance > 0:
                if contracted:
                    t += stride
                else:
                    t += march.step * steps_out_of_cell(box, march.step, distance, i, j, k, x, y, z, dx, dy, dz)
                continue
            q = (tail & (QUEUE - 1)) * 4
            queue[q], queue[q + 1], queue[q + 2], queue[q + 3] = x, y, z, t
            tail += 1
            t += stride
            prefetch_point(grid, x, y, z, finest)
            if finest > 2:
                prefetch_point(grid, x, y, z, finest - 1)
                prefetch_point(grid, x, y, z, finest - 2)
        if head == tail or n >= capacity:
            break
        q = (head & (QUEUE - 1)) * 4
        x, y, z = at(queue, q), at(queue, q + 1), at(queue, q + 2)
        head += 1
        evaluations += 1
        log_density = march.density_bias + interpolate_point_numba(grid, x, y, z, out.features, n * width)
        if log_density > MIN_LOG_DENSITY:
            tau = math.exp(min(log_density, MAX_LOG_DENSITY)) * march.depth_scale
            alpha = one - math.exp(-tau)
            if transmittance * alpha > march.min_weight:
                out.position[n * 3], out.position[n * 3 + 1], out.position[n * 3 + 2] = x, y, z
                out.distance[n] = at(queue, q + 3)
                out.alpha[n], out.tau[n], out.transmittance[n], out.ray[n] = alpha, tau, transmittance, ray
                n += 1
            transmittance *= one - alpha
            if transmittance < march.early_stop_eps:
                break
    return n, transmittance, evaluations


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def march_rays(grid, box, march, origins, directions, jitter, far, num_rays, width, out, first, end_transmittance):
    """March rays until their samples fill the capacity; returns (rays, samples, density evaluations).

    origins, directions: flat (r, 3). first: (r + 1) row of the first sample of each ray. end_transmittance: (r).
    A ray that found the capacity taken is left to the next call.
    """
    capacity = out.alpha.shape[0]
    queue = np.empty(QUEUE * 4, np.float32)
    contracted, half_side = box.space.kind == CONTRACTED, box.space.half_side
    n, evaluations, ray = 0, 0, 0
    while ray < num_rays:
        first[ray] = n
        n, end_transmittance[ray], steps = march_ray(
            grid,
            box,
            march,
            contracted,
            half_side,
            origins,
            directions,
            ray,
            jitter[ray],
            far,
            n,
            capacity,
            width,
            out,
            queue,
        )
        if n >= capacity and ray > 0:
            n = first[ray]
            break
        evaluations += steps
        ray += 1
    first[ray] = n
    return ray, n, evaluations
