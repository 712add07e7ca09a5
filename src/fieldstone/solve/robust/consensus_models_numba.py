"""The models that RANSAC finds: all that the loop in `consensus_numba` asks of one. A new model is added here.

A model is a row of 12 numbers. Each has a row in MODELS and a branch in each of the three functions below: its minimal
solver, its score and its local refinement. (A tuple of functions in place of the branches works, but numba keeps
nothing compiled for it: the type of a function is another one in every process.)

| kind        | data                        | model               |
|-------------|-----------------------------|---------------------|
| POSE        | 8 rows (reprojection_numba) | R, t                |
| ESSENTIAL   | 6 rows (epipolar_numba)     | R, t with |t| = 1   |
| FUNDAMENTAL | 6 rows                      | F                   |
| HOMOGRAPHY  | 8 rows, points (x1, y1, 1)  | H, then zeros       |
| PARALLAX    | 6 rows; a homography given  | F = [e2]_x H        |
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.algebra.small_linear_numba import copy_row_numba
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


class MinimalSolver(NamedTuple):
    """What sampling needs to know of a model."""

    sample_size: int
    cost: float
    """Of one minimal solution, in units of scoring one correspondence."""


POSE, ESSENTIAL, FUNDAMENTAL, HOMOGRAPHY, PARALLAX = 0, 1, 2, 3, 4
MODELS = {
    POSE: MinimalSolver(3, 200.0),
    ESSENTIAL: MinimalSolver(5, 4000.0),
    FUNDAMENTAL: MinimalSolver(7, 600.0),
    HOMOGRAPHY: MinimalSolver(4, 300.0),
    PARALLAX: MinimalSolver(2, 50.0),
}
SAMPLE_SIZE = tuple(MODELS[kind].sample_size for kind in range(len(MODELS)))
SOLVER_COST = tuple(MODELS[kind].cost for kind in range(len(MODELS)))
MAX_SAMPLE, MAX_MODELS = max(SAMPLE_SIZE), 10


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def minimal_models_numba(kind, data, sample, given, left, right, models):
    """Models of one sample; those that put a sampled point behind a camera are left out.

    `left` and `right` (MAX_SAMPLE, 3) are buffers; `given` is the homography of PARALLAX.
    """
    if kind == POSE:
        _bearings_and_points(data, sample, left, right)
        return p3p_numba(left, right, models)
    # Rows of the first and of the second photo; a homography's are in the order of a pose's.
    first, second = (2, 0) if kind == HOMOGRAPHY else (0, 2)
    _matched_points(data, sample, first, second, left, right)
    if kind == FUNDAMENTAL:
        return seven_point_numba(left, right, models)
    if kind == HOMOGRAPHY:
        return homography_numba(left, right, models)
    if kind == PARALLAX:
        return plane_and_parallax_numba(left, right, given, models)
    return _consistent_poses(data, sample, five_point_numba(left, right, models), models)


@njit(cache=True, nogil=True)
@no_type_check
def score_model_numba(kind, model, data, threshold2, max_cost, early_test, scratch):
    """Truncated cost (inf if rejected early), inliers and correspondences looked at."""
    if kind in (POSE, HOMOGRAPHY):
        return score_pose_numba(model, data, threshold2, max_cost, early_test)
    if kind == ESSENTIAL:
        essential_from_state_numba(model, scratch)
    else:
        copy_row_numba(model, scratch)
    return score_epipolar_numba(scratch, data, threshold2, max_cost, early_test)


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


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _bearings_and_points(data, sample, bearings, points):
    """Unit bearings and points in the world of a sample of a pose's data."""
    for i in range(len(sample)):
        u, v = data[0, sample[i]], data[1, sample[i]]
        h = 1.0 / np.sqrt(u * u + v * v + 1.0)
        bearings[i, 0], bearings[i, 1], bearings[i, 2] = u * h, v * h, h
        points[i, 0], points[i, 1], points[i, 2] = data[2, sample[i]], data[3, sample[i]], data[4, sample[i]]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _matched_points(data, sample, first, second, x1, x2):
    """Homogeneous coordinates of a sample of matches, from rows `first` and `second` on."""
    for i in range(len(sample)):
        x1[i, 0], x1[i, 1], x1[i, 2] = data[first, sample[i]], data[first + 1, sample[i]], 1.0
        x2[i, 0], x2[i, 1], x2[i, 2] = data[second, sample[i]], data[second + 1, sample[i]], 1.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _consistent_poses(data, sample, count, models):
    """Turn essential matrices, in place, into those poses that see the sample from its front; how many there are."""
    pose = np.empty(12)
    kept = 0
    for k in range(count):
        if consistent_sample_numba(models[k], data, sample, pose):
            copy_row_numba(pose, models[kept])
            kept += 1
    return kept
