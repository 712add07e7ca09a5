"""Locally optimised RANSAC, one compiled call per problem.

The loop knows a model only as a row of 12 numbers and a `kind`, which chooses the minimal solver, the score and the
local refinement. Columns of `data` are in random order, so that a model can be judged on the first few of them.

| kind        | data                        | model               | sample |
|-------------|-----------------------------|---------------------|--------|
| POSE        | 8 rows (reprojection_numba) | R, t                | 3      |
| ESSENTIAL   | 6 rows (epipolar_numba)     | R, t with |t| = 1   | 5      |
| FUNDAMENTAL | 6 rows                      | F                   | 7      |
| HOMOGRAPHY  | 8 rows, points (x1, y1, 1)  | H, then zeros       | 4      |
| PARALLAX    | 6 rows; a homography given  | F = [e2]_x H        | 2      |
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.algebra.small_linear_numba import copy_row_numba, draw_distinct_numba
from fieldstone.solve.minimal.five_point import five_point_numba
from fieldstone.solve.minimal.p3p import p3p_numba
from fieldstone.solve.minimal.seven_point import seven_point_numba
from fieldstone.solve.robust.epipolar_numba import score_epipolar_numba
from fieldstone.solve.robust.essential_numba import (
    consistent_sample_numba,
    essential_from_state_numba,
    refine_essential_numba,
)
from fieldstone.solve.robust.fundamental_numba import plane_and_parallax_numba, refine_fundamental_numba
from fieldstone.solve.robust.homography import homography_numba, refine_homography_numba
from fieldstone.solve.robust.reprojection_numba import refine_pose_numba, score_pose_numba

POSE, ESSENTIAL, FUNDAMENTAL, HOMOGRAPHY, PARALLAX = 0, 1, 2, 3, 4
SAMPLE_SIZE = (3, 5, 7, 4, 2)
# Cost of one minimal solution, in units of scoring one correspondence.
SOLVER_COST = (200.0, 4000.0, 600.0, 300.0, 50.0)
MAX_SAMPLE, MAX_MODELS = 7, 10
LOCAL_TOLERANCE = 1e-4
# A minimal model is refined first with a wider, soft loss, then with the score itself.
WIDE_THRESHOLD2 = 4.0
# Samples of inliers only, but noisy ones, can miss the best minimum: draw this many times more than one of them.
TRIAL_FACTOR = 3.0
PROSAC_DRAWS = 20_000.0


@njit(cache=True, nogil=True)
@no_type_check
def consensus_numba(
    kind, data, pool, progressive, threshold2, confidence, min_trials, max_trials, local_steps, seed, best
):
    """The model with the lowest truncated cost, into `best` (12,).

    Every minimal model that beats all earlier minimal models is refined on all correspondences. Sampling stops when
    a sample of inliers only was drawn with the given confidence, counting those that the early test loses.

    Args:
        pool: Columns of `data` that samples are drawn from.
        progressive: The pool is sorted from best to worst, and good ones are drawn first (PROSAC).
        best: On entry the homography, for PARALLAX.

    Returns:
        Truncated cost, inliers, trials; the cost is inf if no sample gave a model.

    Source:
        `chum2003` and `lebeda2012` for the local optimisation; `chum2005` for the order of sampling;
        `matas2005` for the early test. Departure: the test runs on blocks of correspondences, and starts from the
        inlier ratio of the best minimal model.
    """
    n, size = data.shape[1], SAMPLE_SIZE[kind]
    outside = n - len(pool)
    state, growth = np.empty(1, np.uint64), np.empty(3)
    state[0] = seed
    start_growth_numba(growth, size, len(pool), progressive)
    sample, left, right = np.empty(size, np.int64), np.empty((MAX_SAMPLE, 3)), np.empty((MAX_SAMPLE, 3))
    models, refined, given = np.zeros((MAX_MODELS, 12)), np.empty(12), best.copy()
    best_cost, best_inliers, best_minimal = np.inf, 0.0, np.inf
    gain_in, gain_out, log_limit = 0.0, 0.0, np.inf
    good_ratio, rejected_inliers, rejected_seen = 0.0, 0.0, 0.0
    needed, trial, best_index = max_trials, 0, 0
    while trial < needed:
        trial += 1
        draw_sample_numba(state, growth, trial, pool, sample)
        count = minimal_models_numba(kind, data, sample, given, left, right, models)
        improved = False
        for k in range(count):
            cost, inliers, seen = score_model_numba(
                kind, models[k], data, threshold2, best_minimal, gain_in, gain_out, log_limit, refined
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
        gain_in, gain_out, log_limit = early_test_numba(good_ratio, bad_ratio, SOLVER_COST[kind])
        ratio = max(best_inliers - outside, 0.0) / len(pool)
        kept = 1.0 - np.exp(-log_limit)
        needed = trials_needed_numba(ratio, size, confidence, kept, min_trials, max_trials)
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


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def minimal_models_numba(kind, data, sample, given, left, right, models):
    """Models of one sample; those that put a sampled point behind a camera are left out."""
    if kind == POSE:
        for i in range(len(sample)):
            u, v = data[0, sample[i]], data[1, sample[i]]
            h = 1.0 / np.sqrt(u * u + v * v + 1.0)
            left[i, 0], left[i, 1], left[i, 2] = u * h, v * h, h
            right[i, 0], right[i, 1], right[i, 2] = data[2, sample[i]], data[3, sample[i]], data[4, sample[i]]
        return p3p_numba(left, right, models)
    # Rows of the first and of the second photo; a homography's are in the order of a pose's.
    first, second = (2, 0) if kind == HOMOGRAPHY else (0, 2)
    for i in range(len(sample)):
        left[i, 0], left[i, 1], left[i, 2] = data[first, sample[i]], data[first + 1, sample[i]], 1.0
        right[i, 0], right[i, 1], right[i, 2] = data[second, sample[i]], data[second + 1, sample[i]], 1.0
    if kind == FUNDAMENTAL:
        return seven_point_numba(left, right, models)
    if kind == HOMOGRAPHY:
        return homography_numba(left, right, models)
    if kind == PARALLAX:
        return plane_and_parallax_numba(left, right, given, models)
    count = five_point_numba(left, right, models)
    pose = np.empty(12)
    kept = 0
    for k in range(count):
        if consistent_sample_numba(models[k], data, sample, pose):
            copy_row_numba(pose, models[kept])
            kept += 1
    return kept


@njit(cache=True, nogil=True)
@no_type_check
def score_model_numba(kind, model, data, threshold2, max_cost, gain_in, gain_out, log_limit, scratch):
    """Truncated cost (inf if rejected early), inliers and correspondences looked at."""
    if kind in (POSE, HOMOGRAPHY):
        return score_pose_numba(model, data, threshold2, max_cost, gain_in, gain_out, log_limit)
    if kind == ESSENTIAL:
        essential_from_state_numba(model, scratch)
    else:
        copy_row_numba(model, scratch)
    return score_epipolar_numba(scratch, data, threshold2, max_cost, gain_in, gain_out, log_limit)


@njit(cache=True, nogil=True)
@no_type_check
def refine_model_numba(kind, model, data, threshold2, softness, tolerance, max_steps):
    """Local refinement in place; truncated cost and inliers."""
    if kind == POSE:
        return refine_pose_numba(model, data, threshold2, softness, tolerance, max_steps)
    if kind == ESSENTIAL:
        return refine_essential_numba(model, data, threshold2, softness, tolerance, max_steps)
    if kind == HOMOGRAPHY:
        return refine_homography_numba(model, data, threshold2, softness, tolerance, max_steps)
    return refine_fundamental_numba(model, data, threshold2, softness, tolerance, max_steps)
