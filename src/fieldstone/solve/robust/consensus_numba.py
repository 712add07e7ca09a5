"""Locally optimised RANSAC, one compiled call per problem.

The loop knows a model only as a row of 12 numbers and a `kind`; `consensus_models_numba` holds what is particular to
each. Columns of `data` are in random order, so that a model can be judged on the first few of them.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Int
from numba import njit

from fieldstone.solve.algebra.small_linear_numba import copy_row_numba, draw_distinct_numba
from fieldstone.solve.robust.consensus_models_numba import (
    MAX_MODELS,
    MAX_SAMPLE,
    SAMPLE_SIZE,
    SOLVER_COST,
    minimal_models_numba,
    refine_model_numba,
    score_model_numba,
)
from fieldstone.solve.robust.early_test_numba import ACCEPT_ALL, early_test_numba

LOCAL_TOLERANCE = 1e-4
# A minimal model is refined first with a wider, soft loss, then with the score itself.
WIDE_THRESHOLD2 = 4.0
# Samples of inliers only, but noisy ones, can miss the best minimum: draw this many times more than one of them.
TRIAL_FACTOR = 3.0
PROSAC_DRAWS = 20_000.0


class Sampling(NamedTuple):
    """Which samples are drawn, how many, and how far the models that win are refined."""

    pool: Int[np.ndarray, "p"]
    """Columns of the data that samples are drawn from."""
    progressive: bool
    """The pool is sorted from best to worst, and good ones are drawn first (PROSAC)."""
    confidence: float
    min_trials: int
    max_trials: int
    local_steps: int
    seed: np.uint64


@njit(cache=True, nogil=True)
@no_type_check
def consensus_numba(kind, data, sampling, threshold2, best):
    """The model with the lowest truncated cost, into `best` (12,).

    Every minimal model that beats all earlier minimal models is refined on all correspondences. Sampling stops when
    a sample of inliers only was drawn with the given confidence, counting those that the early test loses.

    Args:
        best: On entry the homography, for PARALLAX.

    Returns:
        Truncated cost, inliers, trials; the cost is inf if no sample gave a model.

    Source:
        `chum2003` and `lebeda2012` for the local optimisation; `chum2005` for the order of sampling;
        `matas2005` for the early test. Departure: the test runs on blocks of correspondences, and starts from the
        inlier ratio of the best minimal model.
    """
    n, size = data.shape[1], SAMPLE_SIZE[kind]
    pool, local_steps, max_trials = sampling.pool, sampling.local_steps, sampling.max_trials
    outside = n - len(pool)
    state, growth = np.empty(1, np.uint64), np.empty(3)
    state[0] = sampling.seed
    start_growth_numba(growth, size, len(pool), sampling.progressive)
    sample, left, right = np.empty(size, np.int64), np.empty((MAX_SAMPLE, 3)), np.empty((MAX_SAMPLE, 3))
    models, refined, given = np.zeros((MAX_MODELS, 12)), np.empty(12), best.copy()
    best_cost, best_inliers, best_minimal = np.inf, 0.0, np.inf
    early_test = ACCEPT_ALL
    good_ratio, rejected_inliers, rejected_seen = 0.0, 0.0, 0.0
    needed, trial, best_index = max_trials, 0, 0
    while trial < needed:
        trial += 1
        draw_sample_numba(state, growth, trial, pool, sample)
        count = minimal_models_numba(kind, data, sample, given, left, right, models)
        improved = False
        for k in range(count):
            cost, inliers, seen = score_model_numba(
                kind, models[k], data, threshold2, best_minimal, early_test, refined
            )
            if cost < best_minimal:
                best_minimal, good_ratio, improved = cost, inliers / n, True
                best_index = k
            else:
                rejected_inliers += inliers
                rejected_seen += seen
        if not improved:
            continue
        copy_row_numba(models[best_index], refined)
        refine_model_numba(
            kind, refined, data, WIDE_THRESHOLD2 * threshold2, 1.0 / threshold2, LOCAL_TOLERANCE, local_steps
        )
        cost, inliers = refine_model_numba(kind, refined, data, threshold2, 0.0, LOCAL_TOLERANCE, local_steps)
        if cost < best_cost:
            best_cost, best_inliers = cost, inliers
            copy_row_numba(refined, best)
        bad_ratio = max(rejected_inliers / rejected_seen, 0.005) if rejected_seen > 0.0 else 0.05
        early_test = early_test_numba(good_ratio, bad_ratio, SOLVER_COST[kind])
        ratio = max(best_inliers - outside, 0.0) / len(pool)
        kept = 1.0 - np.exp(-early_test.log_limit)
        needed = trials_needed_numba(ratio, size, kept, sampling)
    return best_cost, best_inliers, trial


@njit(cache=True, nogil=True)
@no_type_check
def start_growth_numba(growth, size, count, progressive):
    """Pool size, expected draws from it and the trial at which it grows; the whole pool at once without order.

    Source:
        `chum2005`, eq. 3.
    """
    growth[0], growth[1], growth[2] = count, np.inf, np.inf
    if progressive:
        growth[0], growth[1], growth[2] = size, PROSAC_DRAWS, 1.0
        for i in range(size):
            growth[1] *= (size - i) / (count - i)


@njit(cache=True, nogil=True)
@no_type_check
def draw_sample_numba(state, growth, trial, pool, sample):
    """Different columns of the pool: any, or (PROSAC) the newest of its best part and others better than it.

    Source:
        `chum2005`, algorithm 1.
    """
    size = len(sample)
    while growth[0] < len(pool) and trial > growth[2]:
        draws = growth[1] * (growth[0] + 1.0) / (growth[0] + 1.0 - size)
        growth[2] += np.ceil(draws - growth[1])
        growth[1] = draws
        growth[0] += 1.0
    top = int(growth[0])
    if top >= len(pool):
        draw_distinct_numba(state, len(pool), size, sample)
    else:
        draw_distinct_numba(state, top - 1, size - 1, sample)
        sample[size - 1] = top - 1
    for i in range(size):
        sample[i] = pool[sample[i]]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def trials_needed_numba(inlier_ratio, size, kept, sampling):
    """TRIAL_FACTOR times the trials until, with the given confidence, an all-inlier sample passed the early test."""
    success = kept * inlier_ratio**size
    if success >= 1.0 - 1e-12:
        return sampling.min_trials
    if success <= 1e-12:
        return sampling.max_trials
    trials = np.ceil(TRIAL_FACTOR * np.log(1.0 - sampling.confidence) / np.log(1.0 - success))
    return int(min(max(trials, sampling.min_trials), sampling.max_trials))
