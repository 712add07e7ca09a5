"""What the steps of a grid field work in, allocated once for every size of the grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.field.grid.buffers import Chunk, part_of, ray_buffers, sample_buffers, work_buffers
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.interpolation_numba import BLOCK
from fieldstone.field.grid.layout import GridArrays
from fieldstone.field.grid.march_numba import Box, March, Samples
from fieldstone.field.grid_training.plan import GridPlan

RAYS_PER_DEPTH_RAY = 8
"""A chunk draws one ray to a triangulated point for so many others."""


@dataclass(frozen=True, eq=False)
class StepBuffers:
    """A field as the kernels take it, and buffers; everything here is overwritten by the next step."""

    grid: GridArrays
    box: Box
    march: March
    samples: Samples
    """Of all chunks, one after the other."""
    chunks: tuple[Chunk, ...]
    """Views into `samples`, and what each chunk needs besides."""
    gradient: Float[np.ndarray, "g"]
    """Of the levels that are stepped batch by batch; all 0 between steps."""
    touched: UInt8[np.ndarray, "b"]
    """Which blocks of `gradient` are not 0."""
    steps_done: Int[np.ndarray, ""]
    """Steps that the arrays of the state have gone through, see `state.claim`."""


def step_buffers(field: GridField, plan: GridPlan, num_images: int, steps_done: int) -> StepBuffers:
    """Buffers for the steps of a plan on a field, with so many photos."""
    layout, sampling, width = field.layout, plan.sampling, field.width
    capacity = sampling.samples_per_chunk
    samples = sample_buffers(capacity * sampling.num_chunks, width)
    num_gradients = int(layout.offsets[max(layout.num_levels - plan.rates.immediate_levels, 0)])
    num_blocks = -(-num_gradients // (8 * BLOCK)) * 8
    return StepBuffers(
        grid=layout.arrays(field.table),
        box=field.box(),
        march=field.march(sampling.min_weight, sampling.early_stop_eps),
        samples=samples,
        chunks=tuple(
            _chunk(part_of(samples, n, capacity, width), capacity, field.decoder, num_images)
            for n in range(sampling.num_chunks)
        ),
        gradient=np.zeros(num_blocks * BLOCK, dtype=np.float32),
        touched=np.zeros(num_blocks, dtype=np.uint8),
        steps_done=np.array(steps_done),
    )


def _chunk(samples: Samples, capacity: int, decoder: Decoder, num_images: int) -> Chunk:
    """At most as many rays as samples, and those to triangulated points."""
    max_rays = capacity + capacity // RAYS_PER_DEPTH_RAY
    return Chunk(
        rays=ray_buffers(max_rays),
        samples=samples,
        work=work_buffers(max_rays, capacity),
        gradient=Decoder(*(np.zeros_like(weights) for weights in decoder)),
        gain_gradient=np.zeros(3 * num_images, dtype=np.float32),
    )
