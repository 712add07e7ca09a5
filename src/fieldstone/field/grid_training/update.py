"""What a step of the fast field moves once its gradients are known: grids and decoder.

Pieces of the table are fixed, so that any number of threads gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.field import FastField
from fieldstone.field.grid.interpolation_numba import BLOCK, add_gradient, step_by_sample, step_touched
from fieldstone.field.grid.layout import CHANNELS
from fieldstone.field.grid_training.buffers import Workspace
from fieldstone.field.grid_training.plan import FastPlan

EPSILON = np.float32(1e-8)
DECODER_MEMORY = (0.9, 0.99)

WORD = 8 * BLOCK
"""Pieces of the table begin at multiples of so many values, and so do levels."""

SPLITS = 8
"""Pieces that a level is split into by `step_touched`, if it has at least `SPLIT_WORDS`."""

SPLIT_WORDS = 64

DECAY_BY_LEVEL = 1.5
"""A level gives up so many times as much of itself as the next coarser one."""


def rates_of(plan: FastPlan, share: float) -> Float[np.ndarray, "4"]:
    """Step by channel, with this share of the first learning rates."""
    return np.array([plan.density_rate, *[plan.feature_rate] * (CHANNELS - 1)], dtype=np.float32) * np.float32(share)


def kept_of(plan: FastPlan, share: float, num_levels: int) -> Float[np.ndarray, "l 4"]:
    """What a step leaves of the values of a vertex of each level, coarse to fine, by channel."""
    kept = np.ones((num_levels, CHANNELS), dtype=np.float32)
    finer = np.arange(1, num_levels)
    kept[1:, 0] -= plan.density_rate * share * plan.fine_decay * DECAY_BY_LEVEL ** (finer - float(num_levels - 1))
    return kept


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
    levels = field.layout.num_levels
    rates, kept = np.tile(rates_of(plan, share), 2), np.tile(kept_of(plan, share, levels), 2)
    decay = np.float32(plan.decay)
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
            step_by_sample(*arguments, velocity, rates, kept[level], decay, EPSILON)

    list(executor.map(add, [(level, half) for level in reversed(range(levels)) for half in (0, 1)]))

    def move(piece: tuple[int, int, int]) -> None:
        level, first, last = piece
        step_touched(
            field.table, velocity, room.gradient, room.touched, 8 * first, 8 * last, rates, kept[level], decay, EPSILON
        )

    words = field.layout.offsets // WORD
    list(executor.map(move, [piece for level in range(first_immediate) for piece in _pieces(level, words)]))


def _pieces(level: int, words: Int[np.ndarray, "l_plus_1"]) -> list[tuple[int, int, int]]:
    """A level in ranges of words: (level, first, last)."""
    start, end = words[level : level + 2].tolist()
    parts = SPLITS if end - start >= SPLIT_WORDS else 1
    bounds = [start + (end - start) * k // parts for k in range(parts + 1)]
    return [(level, first, last) for first, last in pairwise(bounds)]


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
