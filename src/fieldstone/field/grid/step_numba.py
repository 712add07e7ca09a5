"""One chunk of a training step: draw rays, march, decode, composite, and back to gradients."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from fieldstone.field.base.space_numba import marched_ray_numba
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.decoder_numba import decode_backward, decode_directions, decode_numba
from fieldstone.field.grid.march_numba import Samples, composite_backward, march_rays
from fieldstone.field.grid.simd_numba import prefetch
from fieldstone.field.grid.terms_numba import point_terms

AHEAD = 16
"""Rays between asking for a row of the table and using it."""

GRADIENT_SCALE = np.float32(1e-2)
"""Constant factor on all gradients; RMSprop and Adam do not depend on it."""


class RayBatch(NamedTuple):
    """Rays of one chunk, flat."""

    origins: np.ndarray
    directions: np.ndarray
    """As marched: in the field's own space."""
    views: np.ndarray
    """Directions as the camera looks, for the decoder."""
    target: np.ndarray
    background: np.ndarray
    image: np.ndarray
    """Which photo shows the ray."""
    gain: np.ndarray
    """Of that photo: how bright it shows each channel."""
    point: np.ndarray
    """Row of the known point on the ray, -1 without one."""
    free: np.ndarray
    """Distance before which the ray probably meets nothing."""
    jitter: np.ndarray
    first: np.ndarray
    passed: np.ndarray


class Work(NamedTuple):
    """What the samples and rays of one chunk need on the way, flat."""

    per_ray: np.ndarray
    d_per_ray: np.ndarray
    hidden: np.ndarray
    rgb: np.ndarray
    d_color: np.ndarray
    d_raw: np.ndarray
    d_weight: np.ndarray
    d_gain: np.ndarray


class Chunk(NamedTuple):
    """Room for one chunk. gradient, gain_gradient: of the decoder and of the exposures, summed over the chunk."""

    rays: RayBatch
    samples: Samples
    work: Work
    gradient: Decoder
    gain_gradient: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def random_share(seed, number):
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
        rays.point[n] = row
        rays.free[n] = table.free[row]
        rays.jitter[n] = random_share(seed, start + k)
        marched_ray_numba(space, rays.origins, rays.directions, n)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def chunk_step(
    table,
    start,
    count,
    known,
    points,
    first_known,
    num_known,
    gains,
    seed,
    background,
    grid,
    box,
    march,
    far,
    terms,
    decoder,
    transposed,
    width,
    chunk,
):
    """Gradients of one chunk: of the decoder in chunk.gradient, of the interpolated values in samples.features.

    The first `num_known` rays are those of the table `known`, from number `first_known` on, with `points` on them.
    Returns (rays, samples, steps asked, sum of squared colour errors).
    """
    rays, samples, work = chunk.rays, chunk.samples, chunk.work
    used = 4 * grid.per_unit.shape[0]
    draw_rays(known, box.space, gains, first_known, num_known, seed + 1, background, rays, 0)
    draw_rays(table, box.space, gains, start, count, seed, background, rays, num_known)
    rays.point[num_known : num_known + count] = -1
    num_rays, n, asked = march_rays(
        grid, box, march, rays.origins, rays.directions, rays.jitter, far, num_known + count, width, samples,
        rays.first, rays.passed,
    )  # fmt: skip
    decode_directions(decoder, rays.views, num_rays, work.per_ray)
    decode_numba(decoder, n, samples.features, width, used, samples.ray, work.per_ray, work.hidden, work.rgb)
    point_terms(
        samples, num_rays, rays.first, rays.point, rays.free, points, march.step, terms.points, terms.free,
        work.d_weight,
    )  # fmt: skip
    loss = composite_backward(
        samples, num_rays, rays.first, rays.passed, rays.target, rays.background, rays.gain, work.rgb, work.d_weight,
        GRADIENT_SCALE, terms.sparsity, terms.emptiness, work.d_color, work.d_raw, work.d_gain,
    )  # fmt: skip
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
        decoder, transposed, n, num_rays, samples.features, width, used, samples.ray, rays.views, work.hidden,
        work.d_color, work.d_raw, work.d_per_ray, chunk.gradient,
    )  # fmt: skip
    return num_rays, n, asked, loss
