"""Kernels that walk rays through a fast field: where there is something, what weighs, and how the loss pulls at it.

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

MIN_RAW, MAX_RAW = np.float32(-7.0), np.float32(10.0)
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
    raw_offset: np.float32
    """Raw density of an untouched grid; the density is exp(raw + raw_offset)."""
    depth_scale: np.float32
    """Optical depth of one step at density 1."""
    min_weight: np.float32
    """Samples that give less to the pixel than this are left out."""
    min_light: np.float32
    """A ray ends where less light than this is left."""
    near: np.float32
    """Where rays begin: nothing can be learned of what is nearer."""


class Samples(NamedTuple):
    """What weighs along a batch of rays, ray by ray; flat arrays with room for `capacity` samples."""

    position: np.ndarray
    distance: np.ndarray
    alpha: np.ndarray
    tau: np.ndarray
    light: np.ndarray
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
def march_ray(grid, box, march, origins, directions, ray, jitter, far, n, capacity, width, out, queue):
    """Append the samples of one ray behind the n there are; returns (n, light left, steps asked).

    jitter: share of a step before the first sample. far: where the ray ends at the latest.
    """
    zero, one = np.float32(0), np.float32(1)
    contracted = box.space.kind == CONTRACTED
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
    light = one
    if not dx * dx + dy * dy + dz * dz > zero:  # nan, outside of a lens: it would never leave the box
        return n, light, 0
    t += jitter * march.step
    nx, ny, nz = at(box.cells, 0), at(box.cells, 1), at(box.cells, 2)
    per_cell = one / box.cell_size
    finest = grid.per_unit.shape[0] - 1
    asked, head, tail = 0, 0, 0
    while True:
        while t < t_end and tail - head < QUEUE:
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            stride = march.step
            if contracted:
                x, y, z, reach = contract_numba(x, y, z, box.space.half_side)
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
        asked += 1
        raw = march.raw_offset + interpolate_point_numba(grid, x, y, z, out.features, n * width)
        if raw > MIN_RAW:
            tau = math.exp(min(raw, MAX_RAW)) * march.depth_scale
            alpha = one - math.exp(-tau)
            if light * alpha > march.min_weight:
                out.position[n * 3], out.position[n * 3 + 1], out.position[n * 3 + 2] = x, y, z
                out.distance[n] = at(queue, q + 3)
                out.alpha[n], out.tau[n], out.light[n], out.ray[n] = alpha, tau, light, ray
                n += 1
            light *= one - alpha
            if light < march.min_light:
                break
    return n, light, asked


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def march_rays(grid, box, march, origins, directions, jitter, far, num_rays, width, out, first, passed):
    """March rays until their samples fill the room; returns (rays, samples, steps asked).

    origins, directions: flat (r, 3). first: (r + 1) row of the first sample of each ray. passed: (r) light left.
    A ray that found its room taken is left to the next call.
    """
    capacity = out.alpha.shape[0]
    queue = np.empty(QUEUE * 4, np.float32)
    n, asked, ray = 0, 0, 0
    while ray < num_rays:
        first[ray] = n
        n, passed[ray], steps = march_ray(
            grid, box, march, origins, directions, ray, jitter[ray], far, n, capacity, width, out, queue
        )
        if n >= capacity and ray > 0:
            n = first[ray]
            break
        asked += steps
        ray += 1
    first[ray] = n
    return ray, n, asked


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def composite_numba(samples, num_rays, first, passed, far, background, rgb, color, depth, opacity):
    """Colours, expected distances and opacities of rays from their samples, as `volume_rendering.composite`.

    background: (r, 3) flat. rgb: (s, 3) flat, colours of the samples. Light that passes ends at `far`.
    """
    for ray in range(num_rays):
        left = passed[ray]
        r, g, b = left * background[ray * 3], left * background[ray * 3 + 1], left * background[ray * 3 + 2]
        total, t = np.float32(0), np.float32(0)
        for i in range(first[ray], first[ray + 1]):
            weight = at(samples.light, i) * at(samples.alpha, i)
            r += weight * at(rgb, i * 3)
            g += weight * at(rgb, i * 3 + 1)
            b += weight * at(rgb, i * 3 + 2)
            t += weight * at(samples.distance, i)
            total += weight
        color[ray, 0], color[ray, 1], color[ray, 2] = r, g, b
        depth[ray] = t + (np.float32(1) - total) * far
        opacity[ray] = total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def composite_backward(
    samples,
    num_rays,
    first,
    passed,
    target,
    background,
    gain,
    rgb,
    d_weight,
    scale,
    sparsity,
    emptiness,
    d_color,
    d_raw,
    d_gain,
):
    """Squared colour errors, summed up, and `scale` times half the gradient of this sum and of what else counts.

    A photo shows gain C: its exposure and white balance by channel. The opacity of a ray, 1 - T_end, counts
    `sparsity` times: fog in the colour of the background costs nothing else. Something solid in that colour does not
    feel it, since T_end is 0 anyhow: on rays that show the background exactly, sum log(1 + tau_i) counts `emptiness`
    times. Whatever else counts says by d_weight how it depends on the weight of each sample. With
    g = gain (gain C - target) and w_i = T_i alpha_i:
    dC / dtau_i = T_(i+1) c_i - sum_{j>i} w_j c_j - T_end background,  dtau / draw = tau.
    d_weight: (s) half the derivative by w_i. d_color: (s, 3) gradient before the sigmoid. d_raw: (s). gain, d_gain:
    (r, 3), the gradient by the logarithm of the gain.

    Source:
        `max1995`, section 3, differentiated.
    """
    one = np.float32(1)
    loss = 0.0
    for ray in range(num_rays):
        start, end = first[ray], first[ray + 1]
        left = passed[ray]
        g0, g1, g2 = left * background[ray * 3], left * background[ray * 3 + 1], left * background[ray * 3 + 2]
        for i in range(start, end):
            weight = at(samples.light, i) * at(samples.alpha, i)
            g0 += weight * at(rgb, i * 3)
            g1 += weight * at(rgb, i * 3 + 1)
            g2 += weight * at(rgb, i * 3 + 2)
        r, g, b = gain[ray * 3], gain[ray * 3 + 1], gain[ray * 3 + 2]
        shown0, shown1, shown2 = r * g0, g * g1, b * g2
        g0, g1, g2 = shown0 - target[ray * 3], shown1 - target[ray * 3 + 1], shown2 - target[ray * 3 + 2]
        loss += g0 * g0 + g1 * g1 + g2 * g2
        d_gain[ray * 3], d_gain[ray * 3 + 1] = g0 * shown0 * scale, g1 * shown1 * scale
        d_gain[ray * 3 + 2] = g2 * shown2 * scale
        g0, g1, g2 = g0 * r * scale, g1 * g * scale, g2 * b * scale
        behind = left * (background[ray * 3] * g0 + background[ray * 3 + 1] * g1 + background[ray * 3 + 2] * g2)
        behind -= np.float32(0.5) * scale * sparsity * left
        bare = target[ray * 3] == background[ray * 3] and target[ray * 3 + 1] == background[ray * 3 + 1]
        bare = bare and target[ray * 3 + 2] == background[ray * 3 + 2]
        thinner = np.float32(0.5) * scale * emptiness if bare else np.float32(0)
        for i in range(end - 1, start - 1, -1):
            light, alpha = at(samples.light, i), at(samples.alpha, i)
            weight = light * alpha
            r, g, b = at(rgb, i * 3), at(rgb, i * 3 + 1), at(rgb, i * 3 + 2)
            own = r * g0 + g * g1 + b * g2 + scale * at(d_weight, i)
            tau = at(samples.tau, i)
            d_raw[i] = (light * (one - alpha) * own - behind + thinner / (one + tau)) * tau
            behind += weight * own
            d_color[i * 3] = weight * g0 * r * (one - r)
            d_color[i * 3 + 1] = weight * g1 * g * (one - g)
            d_color[i * 3 + 2] = weight * g2 * b * (one - b)
    return loss
