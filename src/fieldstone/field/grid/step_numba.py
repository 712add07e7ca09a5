"""One chunk of a training step: draw rays, march, decode, composite, and back to gradients."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from fieldstone.field.base.space import PROJECTIVE
from fieldstone.field.base.space_numba import project_ray_numba
from fieldstone.field.grid.composite_numba import composite_backward
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.decoder_numba import decode_backward, decode_directions, decode_numba
from fieldstone.field.grid.layout import GridArrays
from fieldstone.field.grid.march_numba import Box, March, march_rays
from fieldstone.field.grid.rays import RayTable
from fieldstone.field.grid.simd_numba import prefetch
from fieldstone.field.grid.terms_numba import SparseDepths, ray_terms

AHEAD = 16
"""Rays between asking for a row of the table and using it."""

GRADIENT_SCALE = np.float32(1e-2)
"""Constant factor on all gradients; RMSprop and Adam do not depend on it."""


class Model(NamedTuple):
    """A grid field as a step reads it."""

    grid: GridArrays
    box: Box
    march: March
    decoder: Decoder
    transposed: np.ndarray
    """`Decoder.feature_weights` as (hidden, width)."""
    width: int
    """Interpolated values per sample."""


class RaySources(NamedTuple):
    """Where the rays of a step come from."""

    table: RayTable
    depth_rays: RayTable
    """Rays to triangulated points; may be none."""
    sparse_depths: SparseDepths
    """Where those points are."""
    gains: np.ndarray
    """(v, 3) flat: of each photo and channel."""
    background: np.ndarray
    seed: int


class Draw(NamedTuple):
    """Which rays one chunk draws, as numbers in the sequences of both tables."""

    start: int
    num_rays: int
    depth_start: int
    num_depth_rays: int


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def random_uniform(seed, number):
    """A number in [0, 1) that depends on seed and number alone.

    Source:
        `steele2014`, the mixing function of SplitMix64.
    """
    h = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(number) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h ^= h >> np.uint64(31)
    return np.float32(np.int64(h >> np.uint64(40))) * np.float32(1.0 / 16777216.0)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def drawn_row(table, number):
    """The row of the table that is drawn as number `number`."""
    rows = np.uint64(table.image.shape[0])
    return np.int64(np.uint64(number) % rows * np.uint64(table.stride) % rows)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def draw_rays(table, space, gains, start, count, seed, background, rays, at):
    """Rays number `start` to `start + count` of the table's sequence, with colours over the background.

    They are put to place `at` and after. gains: (v, 3) flat, of each photo.
    """
    scale = np.float32(1.0 / 255.0)
    projective, projection = space.kind == PROJECTIVE, space.projection
    for k in range(count):
        n = at + k
        ahead = drawn_row(table, start + k + AHEAD)
        prefetch(table.image, ahead)
        prefetch(table.bearing, ahead)
        prefetch(table.rgba, ahead * 4)
        prefetch(table.bearings, np.int64(table.bearing[drawn_row(table, start + k + AHEAD // 2)]) * 3)
        row = drawn_row(table, start + k)
        v, b = table.image[row], table.bearing[row]
        x, y, z = table.bearings[b, 0], table.bearings[b, 1], table.bearings[b, 2]
        alpha = np.float32(table.rgba[row, 3]) * scale
        for c in range(3):
            rays.origins[n * 3 + c] = table.centers[v, c]
            rays.directions[n * 3 + c] = (
                table.rotations[v, c, 0] * x + table.rotations[v, c, 1] * y + table.rotations[v, c, 2] * z
            )
            rays.views[n * 3 + c] = rays.directions[n * 3 + c]
            rays.background[n * 3 + c] = background[c]
            rays.gain[n * 3 + c] = gains[v * 3 + c]
            color = np.float32(table.rgba[row, c]) * scale
            rays.target[n * 3 + c] = color * alpha + background[c] * (np.float32(1) - alpha)
        rays.image[n] = v
        rays.depth_row[n] = row
        rays.free_distance[n] = table.free_distance[row]
        rays.jitter[n] = random_uniform(seed, start + k)
        if projective:
            project_ray_numba(projection, rays.origins, rays.directions, n)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def chunk_step(model, sources, draw, terms, far, chunk):
    """Gradients of one chunk: of the decoder in chunk.gradient, of the interpolated values in samples.features.

    Rays to triangulated points come first, then those of the table.
    Returns (rays, samples, density evaluations, sum of squared colour errors).
    """
    rays, samples, work, decoder = chunk.rays, chunk.samples, chunk.work, model.decoder
    width, used = model.width, 4 * model.grid.per_unit.shape[0]
    draw_chunk(sources, model.box.space, draw, rays)
    num_rays, n, evaluations = march_rays(
        model.grid,
        model.box,
        model.march,
        rays.origins,
        rays.directions,
        rays.jitter,
        far,
        draw.num_depth_rays + draw.num_rays,
        width,
        samples,
        rays.first,
        rays.end_transmittance,
    )
    decode_directions(decoder, rays.views, num_rays, work.per_ray)
    decode_numba(decoder, n, samples.features, width, used, samples.ray, work.per_ray, work.hidden, work.rgb)
    ray_terms(samples, rays, num_rays, sources.sparse_depths, model.march.step, terms, work.d_weight)
    loss = composite_backward(samples, rays, work, num_rays, terms, GRADIENT_SCALE)
    chunk.gain_gradient[:] = 0
    for ray in range(num_rays):
        for c in range(3):
            chunk.gain_gradient[rays.image[ray] * 3 + c] += work.d_gain[ray * 3 + c]
    chunk.gradient.feature_weights[:] = 0
    chunk.gradient.direction_weights[:] = 0
    chunk.gradient.hidden_bias[:] = 0
    chunk.gradient.color_weights[:] = 0
    chunk.gradient.color_bias[:] = 0
    decode_backward(
        decoder,
        model.transposed,
        n,
        num_rays,
        samples.features,
        width,
        used,
        samples.ray,
        rays.views,
        work.hidden,
        work.d_color,
        work.d_log_density,
        work.d_per_ray,
        chunk.gradient,
    )
    return num_rays, n, evaluations, loss


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def draw_chunk(sources, space, draw, rays):
    """The rays of one chunk: those to triangulated points, then those of the table."""
    gains, seed, background, first = sources.gains, sources.seed, sources.background, draw.num_depth_rays
    draw_rays(sources.depth_rays, space, gains, draw.depth_start, first, seed + 1, background, rays, 0)
    draw_rays(sources.table, space, gains, draw.start, draw.num_rays, seed, background, rays, first)
    rays.depth_row[first : first + draw.num_rays] = -1
