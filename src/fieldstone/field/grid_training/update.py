"""What a step moves once its gradients are known: grids, decoder and exposures.

Pieces of the table are fixed, so that any number of threads gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from fieldstone.field.base.adam import adam_estimates
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.interpolation_numba import BLOCK, add_gradient, step_by_sample, step_touched
from fieldstone.field.grid.layout import CHANNELS
from fieldstone.field.grid_training.plan import LearningRates
from fieldstone.field.grid_training.state import GridState

EPSILON = np.float32(1e-8)
DECODER_BETAS = (0.9, 0.99)

WORD = 8 * BLOCK
"""Pieces of the table begin at multiples of so many values, and so do levels."""

NUM_PIECES = 8
"""Pieces that a level is split into by `step_touched`, if it has at least `MIN_SPLIT_WORDS`."""

MIN_SPLIT_WORDS = 64

DECAY_BY_LEVEL = 1.5
"""The weight decay of a level is so many times that of the next coarser one."""


def rates_by_channel(rates: LearningRates, multiplier: float) -> Float[np.ndarray, "4"]:
    """Step of each channel of a vertex, with the learning rates multiplied."""
    first = np.array([rates.density_rate, *[rates.feature_rate] * (CHANNELS - 1)], dtype=np.float32)
    return first * np.float32(multiplier)


def decay_factors(rates: LearningRates, multiplier: float, num_levels: int) -> Float[np.ndarray, "l 4"]:
    """What weight decay leaves of the values of a vertex of each level, coarse to fine, by channel."""
    factors = np.ones((num_levels, CHANNELS), dtype=np.float32)
    finer = np.arange(1, num_levels)
    by_level = DECAY_BY_LEVEL ** (finer - float(num_levels - 1))
    factors[1:, 0] -= rates.density_rate * multiplier * rates.weight_decay * by_level
    return factors


def step_grid(state: GridState, counts: Int[np.ndarray, "c"], multiplier: float, executor: Executor) -> None:
    """Move the vertices that a batch has touched, level by level and piece by piece.

    Args:
        counts: Samples of each chunk; their gradients lie in the buffers of the state.
        multiplier: Of the learning rates.
    """
    buffers, rates, layout = state.buffers, state.plan.rates, state.field.layout
    levels, capacity = layout.num_levels, state.plan.sampling.samples_per_chunk
    # Kernels step two vertices at a time.
    by_channel = np.tile(rates_by_channel(rates, multiplier), 2)
    factors = np.tile(decay_factors(rates, multiplier, levels), 2)
    decay = np.float32(rates.mean_square_decay)
    first_immediate = max(levels - rates.immediate_levels, 0)

    def add_or_step(piece: tuple[int, int]) -> None:
        level, half = piece
        samples = (counts, capacity, buffers.samples.position, buffers.samples.features, state.field.width)
        if level < first_immediate:
            add_gradient(buffers.grid, level, half, *samples, buffers.gradient, buffers.touched)
        else:
            moments = (state.mean_square, by_channel, factors[level], decay, EPSILON)
            step_by_sample(buffers.grid, level, half, *samples, *moments)

    def step(piece: tuple[int, int, int]) -> None:
        level, first, last = piece
        gradient = (state.mean_square, buffers.gradient, buffers.touched)
        step_touched(state.field.table, *gradient, 8 * first, 8 * last, by_channel, factors[level], decay, EPSILON)

    list(executor.map(add_or_step, [(level, half) for level in reversed(range(levels)) for half in (0, 1)]))
    words = layout.offsets // WORD
    list(executor.map(step, [piece for level in range(first_immediate) for piece in _pieces(level, words)]))


def _pieces(level: int, words: Int[np.ndarray, "l_plus_1"]) -> list[tuple[int, int, int]]:
    """A level in ranges of words: (level, first, last)."""
    start, end = words[level : level + 2].tolist()
    parts = NUM_PIECES if end - start >= MIN_SPLIT_WORDS else 1
    bounds = [start + (end - start) * k // parts for k in range(parts + 1)]
    return [(level, first, last) for first, last in pairwise(bounds)]


def step_decoder(state: GridState, gradients: Sequence[Decoder], multiplier: float) -> None:
    """One step of Adam with the gradients of all chunks, added in their order."""
    rate = np.float32(state.plan.rates.decoder_rate * multiplier)
    for name in Decoder._fields:
        weights = getattr(state.field.decoder, name)
        gradient = np.zeros_like(weights)
        for part in gradients:
            gradient += getattr(part, name)
        moments = (getattr(state.decoder_first_moment, name), getattr(state.decoder_second_moment, name))
        numerator, denominator = adam_estimates(
            *moments, gradient, state.step + 1, betas=DECODER_BETAS, epsilon=float(EPSILON)
        )
        weights[:] -= rate * numerator / denominator
