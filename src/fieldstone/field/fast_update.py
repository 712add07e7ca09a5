"""What a step of the fast field moves once its gradients are known: grids and decoder.

Pieces of the table are fixed, so that any number of threads gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
from jaxtyping import Float, Int

from fieldstone.field.fast_decoder import Decoder
from fieldstone.field.fast_field import FastField
from fieldstone.field.fast_grid import CHANNELS
from fieldstone.field.fast_grid_numba import add_gradient, step_by_sample, step_touched
from fieldstone.field.fast_plan import FastPlan
from fieldstone.field.fast_workspace import Workspace

EPSILON = np.float32(1e-8)
DECODER_MEMORY = (0.9, 0.99)

SPLITS = 8
"""Pieces of the table that `step_touched` is split into."""


def move_grid(
    field: FastField,
    velocity: Float[np.ndarray, "t"],
    plan: FastPlan,
    room: Workspace,
    counts: Int[np.ndarray, "c"],
    share: float,
    executor: Executor,
) -> None:
    """Move the vertices that a batch has touched, level by level and piece by piece.

    Args:
        velocity: Mean squared gradient of each value, updated too.
        counts: Samples of each chunk.
        share: Of the first learning rates.
    """
    rates = np.full(8, plan.feature_rate * share, dtype=np.float32)
    rates[[0, CHANNELS]] = plan.density_rate * share
    decay = np.float32(plan.decay)
    levels = field.layout.num_levels
    first_immediate = max(levels - plan.immediate_levels, 0)

    def add(piece: tuple[int, int]) -> None:
        level, half = piece
        arguments = (
            room.grid, level, half, counts, plan.samples_per_chunk, room.samples.position, room.samples.features,
            field.width,
        )  # fmt: skip
        if level < first_immediate:
            add_gradient(*arguments, room.gradient, room.touched)
        else:
            step_by_sample(*arguments, velocity, rates, decay, EPSILON)

    list(executor.map(add, [(level, half) for level in reversed(range(levels)) for half in (0, 1)]))
    words = len(room.touched) // 8
    bounds = [8 * (words * piece // SPLITS) for piece in range(SPLITS + 1)]

    def move(piece: int) -> None:
        step_touched(
            field.table, velocity, room.gradient, room.touched, bounds[piece], bounds[piece + 1], rates, decay,
            EPSILON,
        )  # fmt: skip

    list(executor.map(move, range(SPLITS)))


def step_decoder(
    decoder: Decoder, mean: Decoder, square: Decoder, gradients: Sequence[Decoder], count: int, rate: np.float32
) -> None:
    """One Adam step with the gradients of all chunks, added in their order; all in place.

    Args:
        mean, square: Running means of the gradient and its square.
        count: Number of this step, from 1.

    Source:
        `kingma2015`, algorithm 1.
    """
    memory, square_memory = (np.float32(m) for m in DECODER_MEMORY)
    first, second = (np.float32(1.0 - m**count) for m in DECODER_MEMORY)
    for name in Decoder._fields:
        gradient = np.zeros_like(getattr(decoder, name))
        for part in gradients:
            gradient += getattr(part, name)
        m, v = getattr(mean, name), getattr(square, name)
        m[:] = memory * m + (1 - memory) * gradient
        v[:] = square_memory * v + (1 - square_memory) * gradient * gradient
        getattr(decoder, name)[:] -= rate * (m / first) / (np.sqrt(v / second) + EPSILON)
