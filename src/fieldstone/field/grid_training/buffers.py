"""Room in which the steps of the fast field work, allocated once for every size of the grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.field.grid.decoder import HIDDEN, Decoder
from fieldstone.field.grid.field import FastField, room_for_samples
from fieldstone.field.grid.interpolation_numba import BLOCK
from fieldstone.field.grid.layout import GridArrays
from fieldstone.field.grid.march_numba import Box, March, Samples
from fieldstone.field.grid.step_numba import Chunk, RayBatch, Work
from fieldstone.field.grid_training.plan import FastPlan

RAYS_PER_KNOWN = 8
"""A chunk draws one ray with a known point for so many others."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """A field as the kernels take it, and buffers; everything here is overwritten by the next step."""

    grid: GridArrays
    box: Box
    march: March
    samples: Samples
    """Of all chunks, one after the other."""
    chunks: tuple[Chunk, ...]
    """Views into `samples`, and what each chunk needs besides."""
    gradient: Float[np.ndarray, "g"]
    """Of the levels that move batch by batch; all 0 between steps."""
    touched: UInt8[np.ndarray, "b"]
    """Which blocks of `gradient` are not 0."""


def workspace(field: FastField, plan: FastPlan, num_images: int) -> Workspace:
    """Room for the steps of a plan on a field, with so many photos."""
    layout = field.layout
    room, width = plan.samples_per_chunk, field.width
    samples = room_for_samples(room * plan.num_chunks, width)
    chunks = tuple(_chunk(samples, n, room, width, field.decoder, num_images) for n in range(plan.num_chunks))
    num_gradients = int(layout.offsets[max(layout.num_levels - plan.immediate_levels, 0)])
    num_blocks = -(-num_gradients // (8 * BLOCK)) * 8
    return Workspace(
        layout.arrays(field.table), field.box(), field.march(plan.min_weight, plan.min_light), samples, chunks,
        np.zeros(num_blocks * BLOCK, dtype=np.float32), np.zeros(num_blocks, dtype=np.uint8),
    )  # fmt: skip


def _chunk(samples: Samples, n: int, room: int, width: int, decoder: Decoder, num_images: int) -> Chunk:
    """Chunk n: its part of the samples, as many rays as samples at most and those of known points, and gradients."""

    def floats(count: int) -> np.ndarray:
        return np.zeros(count, dtype=np.float32)

    def part(array: np.ndarray, size: int, extra: int = 0) -> np.ndarray:
        return array[n * room * size : (n + 1) * room * size + extra]

    own = Samples(
        part(samples.position, 3), part(samples.distance, 1), part(samples.alpha, 1), part(samples.tau, 1),
        part(samples.light, 1), part(samples.ray, 1), part(samples.features, width),
    )  # fmt: skip
    most = room + room // RAYS_PER_KNOWN
    rays = room_for_rays(most)
    work = Work(
        floats(most * HIDDEN), floats(most * HIDDEN), floats(room * HIDDEN), floats(3 * room), floats(3 * room),
        floats(room), floats(room), floats(3 * most),
    )  # fmt: skip
    return Chunk(rays, own, work, Decoder(*(np.zeros_like(weights) for weights in decoder)), floats(3 * num_images))


def room_for_rays(count: int) -> RayBatch:
    """Empty arrays for so many rays."""

    def floats(size: int) -> np.ndarray:
        return np.zeros(size * count, dtype=np.float32)

    return RayBatch(
        floats(3), floats(3), floats(3), floats(3), floats(3), np.zeros(count, dtype=np.int32), floats(3),
        np.zeros(count, dtype=np.int64), floats(1), floats(1), np.zeros(count + 1, dtype=np.int64), floats(1),
    )  # fmt: skip
