"""Locally optimised RANSAC, one compiled call per problem.

The loop knows a model only as a row of 12 numbers and a `kind`, which chooses the minimal solver, the score and the
local refinement. Columns of `data` are in random order, so that a model can be judged on the first few of them.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve import five_point as five
from fieldstone.solve.epipolar_numba import score_epipolar_numba
from fieldstone.solve.essential_numba import (
    consistent_sample_numba,
    essential_from_state_numba,
    refine_essential_numba,
)
from fieldstone.solve.five_point import five_point_numba
from fieldstone.solve.p3p import p3p_numba
from fieldstone.solve.reprojection_numba import refine_pose_numba, score_pose_numba
from fieldstone.solve.small_linear_numba import draw_distinct_numba

POSE, ESSENTIAL = 0, 1
# Cost of one minimal solution, in units of scoring one correspondence.
SOLVER_COST = (200.0, 4000.0)
SAMPLE_SIZE = (3, 5)
MAX_SAMPLE, MAX_MODELS = 8, 10
LOCAL_TOLERANCE = 1e-4
# A minimal model is refined first with a wider, soft loss, then with the score itself.
WIDE_THRESHOLD2, WIDE_STEPS = 4.0, 5
# Samples of inliers only, but noisy ones, can miss the best minimum: draw this many times more than one of them.
TRIAL_FACTOR = 3.0
PROSAC_DRAWS = 20_000.0


@njit(cache=True, nogil=True)
@no_type_check
def consensus_numba(kind, data, ranked, threshold2, confidence, min_trials, max_trials, refine_steps, seed, best):
    """The model with the lowest truncated cost, into `best` (12,).

    Every minimal model that beats all earlier minimal models is refined on all correspondences. Sampling stops when
    a sample of inliers only was drawn with the given confidence, counting those that the early test loses.

    Args:
        ranked: Columns of `data` from best to worst (PROSAC), or empty for uniform sampling.

    Returns:
        Truncated cost, inliers, trials; the cost is inf if no sample gave a model.

    Source:
        `chum2003` and `lebeda2012` for the local optimisation; `chum2005` for the order of sampling;
        `matas2005` for the early test. Departure: the test runs on blocks of correspondences, and starts from the
        inlier ratio of the best minimal model.
    """
    n = data.shape[1]
    size = SAMPLE_SIZE[kind]
    state = np.empty(1, np.uint64)
    state[0] = seed
    sample, work = np.empty(size, np.int64), np.empty(five.END + 30)
    models, refined = np.empty((MAX_MODELS, 12)), np.empty(12)
    best_cost, best_inliers, best_minimal = np.inf, 0.0, np.inf
    gain_in, gain_out, log_limit = 0.0, 0.0, np.inf
    rejected_inliers, rejected_seen = 0.0, 0.0
    needed = max_trials
    pool, growth, next_growth = (size, 1.0, 1.0) if len(ranked) else (n, np.inf, np.inf)
    if len(ranked):
        growth = PROSAC_DRAWS
        for i in range(size):
            growth *= (size - i) / (n - i)
    trial = 0
    while trial < needed:
        trial += 1
        while pool < n and trial > next_growth:
            new_growth = growth * (pool + 1) / (pool + 1 - size)
            next_growth += np.ceil(new_growth - growth)
            growth = new_growth
            pool += 1
        draw_sample_numba(state, pool, n, ranked, sample)
        count = minimal_models_numba(kind, data, sample, work, models)
        improved = False
        for k in range(count):
            cost, inliers, seen = score_model_numba(
                kind, models[k], data, threshold2, best_minimal, gain_in, gain_out, log_limit, work
            )
            if cost < best_minimal:
                best_minimal = cost
                refined[:] = models[k]
                improved = True
                good_ratio = inliers / n
            else:
                rejected_inliers += inliers
                rejected_seen += seen
        if improved:
            wide2 = WIDE_THRESHOLD2 * threshold2
            refine_model_numba(kind, refined, data, wide2, 1.0 / threshold2, LOCAL_TOLERANCE, WIDE_STEPS)
            cost, inliers = refine_model_numba(kind, refined, data, threshold2, 0.0, LOCAL_TOLERANCE, refine_steps)
            if cost < best_cost:
                best_cost, best_inliers = cost, inliers
                best[:] = refined
            bad_ratio = rejected_inliers / rejected_seen if rejected_seen > 0.0 else 0.05
            gain_in, gain_out, log_limit = early_test_numba(good_ratio, max(bad_ratio, 0.005), SOLVER_COST[kind])
            kept = 1.0 - np.exp(-log_limit)
            needed = trials_needed_numba(best_inliers / n, size, confidence, kept, min_trials, max_trials)
    return best_cost, best_inliers, trial


@njit(cache=True, nogil=True)
@no_type_check
def draw_sample_numba(state, pool, n, ranked, sample):
    """Different columns: from all n, or (PROSAC) the newest of the `pool` best and others better than it."""
    size = len(sample)
    if len(ranked) == 0:
        draw_distinct_numba(state, n, size, sample)
        return
    if pool >= n:
        draw_distinct_numba(state, n, size, sample)
    else:
        draw_distinct_numba(state, pool - 1, size - 1, sample)
        sample[size - 1] = pool - 1
    for i in range(size):
        sample[i] = ranked[sample[i]]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def trials_needed_numba(inlier_ratio, size, confidence, kept, min_trials, max_trials):
    """TRIAL_FACTOR times the trials until, with the given confidence, an all-inlier sample passed the early test."""
    success = kept * inlier_ratio**size
    if success >= 1.0 - 1e-12:
        return min_trials
    if success <= 1e-12:
        return max_trials
    trials = np.ceil(TRIAL_FACTOR * np.log(1.0 - confidence) / np.log(1.0 - success))
    return int(min(max(trials, min_trials), max_trials))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def early_test_numba(good_ratio, bad_ratio, solver_cost):
    """Log likelihood ratios of an inlier and an outlier under a bad against a good model, and the limit that rejects.

    The limit A minimises the mean time per good model: A = 1 + t C + log A, with C the mean gain per point.

    Source:
        `matas2005`, section 3, and `chum2008`, eq. 18.
    """
    if bad_ratio >= 0.9 * good_ratio or good_ratio > 0.999:
        return 0.0, 0.0, np.inf
    gain_in = np.log(bad_ratio / good_ratio)
    gain_out = np.log((1.0 - bad_ratio) / (1.0 - good_ratio))
    information = bad_ratio * gain_in + (1.0 - bad_ratio) * gain_out
    A = 1.0 + solver_cost * information
    limit = A
    for _ in range(5):
        limit = A + np.log(limit)
    return gain_in, gain_out, np.log(limit)


@njit(cache=True, nogil=True)
@no_type_check
def minimal_models_numba(kind, data, sample, work, models):
    """Models of one sample; those that put a sampled point behind a camera are left out."""
    if kind == POSE:
        y, X = work[:9].reshape((3, 3)), work[9:18].reshape((3, 3))
        for i in range(3):
            u, v = data[0, sample[i]], data[1, sample[i]]
            h = 1.0 / np.sqrt(u * u + v * v + 1.0)
            y[i, 0], y[i, 1], y[i, 2] = u * h, v * h, h
            X[i, 0], X[i, 1], X[i, 2] = data[2, sample[i]], data[3, sample[i]], data[4, sample[i]]
        return p3p_numba(y, X, models)
    a, b = work[five.END : five.END + 15].reshape((3, 5)), work[five.END + 15 : five.END + 30].reshape((3, 5))
    for i in range(5):
        a[0, i], a[1, i], a[2, i] = data[0, sample[i]], data[1, sample[i]], 1.0
        b[0, i], b[1, i], b[2, i] = data[2, sample[i]], data[3, sample[i]], 1.0
    count = five_point_numba(a, b, models, work)
    kept = 0
    for k in range(count):
        if consistent_sample_numba(models[k], data, sample, work):
            models[kept] = work[:12]
            kept += 1
    return kept


@njit(cache=True, nogil=True)
@no_type_check
def score_model_numba(kind, model, data, threshold2, max_cost, gain_in, gain_out, log_limit, work):
    """Truncated cost (inf if rejected early), inliers and correspondences looked at."""
    if kind == POSE:
        return score_pose_numba(model, data, threshold2, max_cost, gain_in, gain_out, log_limit)
    essential_from_state_numba(model, work)
    return score_epipolar_numba(work, data, threshold2, max_cost, gain_in, gain_out, log_limit)


@njit(cache=True, nogil=True)
@no_type_check
def refine_model_numba(kind, model, data, threshold2, softness, tolerance, max_steps):
    """Local refinement in place; truncated cost and inliers."""
    if kind == POSE:
        return refine_pose_numba(model, data, threshold2, softness, tolerance, max_steps)
    return refine_essential_numba(model, data, threshold2, softness, tolerance, max_steps)
