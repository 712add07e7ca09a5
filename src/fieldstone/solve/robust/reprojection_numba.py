"""Reprojection error of one pose: score with early rejection, normal equations, local refinement.

Correspondences are rows of one array `data` (8, n): ideal image coordinates u, v; the point X, Y, Z in the world; and
w11, w12, w22, which turn an error on the plane z = 1 into pixels: pixels = [[w11, w12], [0, w22]] (du, dv).
A pose is a row of 12 numbers: R row by row, then t, `cam_from_world`.

The score is the truncated sum of squares (MSAC), sum_i min(|r_i|^2, threshold^2), of `torr2000`.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.algebra.block_sums_numba import BLOCK, block_dot, block_sum
from fieldstone.solve.algebra.small_linear_numba import (
    copy_row_numba,
    multiply3_numba,
    rotation_exp_numba,
    solve_damped_numba,
    squared_length_numba,
)

MIN_STEP2 = 1e-22


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _score_block(pose, data, begin, end, threshold2, costs):  # -> truncated cost, inliers of data[:, begin:end]
    """`costs` (BLOCK,) is room for those of the points: sums inside the loop would keep it out of vector registers."""
    R11, R12, R13, R21, R22, R23 = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]
    R31, R32, R33, t1, t2, t3 = pose[6], pose[7], pose[8], pose[9], pose[10], pose[11]
    u, v = data[0, begin:end], data[1, begin:end]
    X, Y, Z = data[2, begin:end], data[3, begin:end], data[4, begin:end]
    w11, w12, w22 = data[5, begin:end], data[6, begin:end], data[7, begin:end]
    inliers = 0
    for i in range(len(u)):
        x = R11 * X[i] + R12 * Y[i] + R13 * Z[i] + t1
        y = R21 * X[i] + R22 * Y[i] + R23 * Z[i] + t2
        z = R31 * X[i] + R32 * Y[i] + R33 * Z[i] + t3
        inv_z = 1.0 / z
        du, dv = x * inv_z - u[i], y * inv_z - v[i]
        r1, r2 = w11[i] * du + w12[i] * dv, w22[i] * dv
        error = r1 * r1 + r2 * r2
        good = (error < threshold2) & (z > 0.0)
        costs[i] = error if good else threshold2
        inliers += 1 if good else 0
    costs[len(u) :] = 0.0
    return block_sum(costs, 0), inliers


@njit(cache=True, nogil=True)
@no_type_check
def score_pose_numba(pose, data, threshold2, max_cost, early_test):
    """Truncated cost, inliers and points looked at; the cost is inf where the pose was rejected before the end.

    Rejected: the cost passes `max_cost`, or the sequential probability ratio test (`EarlyTest`) does.

    Source:
        `matas2005` for the test; in blocks of points rather than after every point.
    """
    n = data.shape[1]
    cost, inliers = 0.0, 0.0
    costs = np.empty(BLOCK)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        block_cost, block_inliers = _score_block(pose, data, begin, end, threshold2, costs)
        cost += block_cost
        inliers += block_inliers
        log_ratio = inliers * early_test.gain_in + (end - inliers) * early_test.gain_out
        if end < n and (cost > max_cost or log_ratio > early_test.log_limit):
            return np.inf, inliers, end
    return cost, inliers, n


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _derivatives_block(
    pose, data, begin, end, threshold2, softness, rows, costs
):  # fills rows (14 BLOCK,), costs (BLOCK,)
    """Weighted derivatives of the first component of the error by the tangent in six rows, then that component;
    then the same for the second component. Rows are pieces of one flat array so that the loop runs in vectors.
    """
    R11, R12, R13, R21, R22, R23 = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]
    R31, R32, R33, t1, t2, t3 = pose[6], pose[7], pose[8], pose[9], pose[10], pose[11]
    u_seen, v_seen = data[0, begin:end], data[1, begin:end]
    X, Y, Z = data[2, begin:end], data[3, begin:end], data[4, begin:end]
    w11, w12, w22 = data[5, begin:end], data[6, begin:end], data[7, begin:end]
    outlier_cost = threshold2 / (1.0 + softness * threshold2)
    inliers = 0
    for i in range(len(X)):
        z = R31 * X[i] + R32 * Y[i] + R33 * Z[i] + t3
        h = 1.0 / (z if z > 0.0 else 1.0)
        u = (R11 * X[i] + R12 * Y[i] + R13 * Z[i] + t1) * h
        v = (R21 * X[i] + R22 * Y[i] + R23 * Z[i] + t2) * h
        du, dv = u - u_seen[i], v - v_seen[i]
        r1, r2 = w11[i] * du + w12[i] * dv, w22[i] * dv
        error = r1 * r1 + r2 * r2
        good = (error < threshold2) & (z > 0.0)
        weight = 1.0 / (1.0 + softness * error)
        costs[i] = error * weight if good else outlier_cost
        inliers += 1 if good else 0
        s = weight if good else 0.0
        p, q, m = s * w11[i], s * w12[i], s * w22[i]
        rows[i] = -p * u * v - q * (1.0 + v * v)
        rows[BLOCK + i] = p * (1.0 + u * u) + q * u * v
        rows[2 * BLOCK + i] = -p * v + q * u
        rows[3 * BLOCK + i] = p * h
        rows[4 * BLOCK + i] = q * h
        rows[5 * BLOCK + i] = -p * u * h - q * v * h
        rows[6 * BLOCK + i] = s * r1
        rows[7 * BLOCK + i] = -m * (1.0 + v * v)
        rows[8 * BLOCK + i] = m * u * v
        rows[9 * BLOCK + i] = m * u
        rows[10 * BLOCK + i] = 0.0
        rows[11 * BLOCK + i] = m * h
        rows[12 * BLOCK + i] = -m * v * h
        rows[13 * BLOCK + i] = s * r2
    costs[len(X) :] = 0.0
    return block_sum(costs, 0), inliers


@njit(cache=True, nogil=True)
@no_type_check
def pose_normal_equations_numba(pose, data, threshold2, softness, rows, S):  # fills S (7, 7) -> cost, inliers
    """Sum over inliers of w (J, r)^T (J, r), whose blocks are J^T W J and J^T W r, for an update
    (omega, v) on the left: x_in_cam <- exp(omega) x_in_cam + v.

    With the tangent in the camera frame the Jacobian of a projection needs u, v and 1/z only:
    du = (-u v, 1 + u^2, -v) omega + (1, 0, -u) v / z;  dv = (-1 - v^2, u v, u) omega + (0, 1, -v) v / z.
    The cost of a correspondence is rho(min(r^2, threshold^2)) with rho(s) = s / (1 + softness s), W = rho'(r^2):
    plain truncated squares for softness 0, and the loss of Geman and McClure with scale c for softness 1 / c^2.

    Source:
        `hartley2004`, section 7.2 (the geometric error of a camera).
    """
    for i in range(7):
        for j in range(7):
            S[i, j] = 0.0
    cost, inliers = 0.0, 0.0
    n = data.shape[1]
    costs = np.empty(BLOCK)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        block_cost, block_inliers = _derivatives_block(pose, data, begin, end, threshold2, softness, rows, costs)
        cost += block_cost
        inliers += block_inliers
        add_outer_products_numba(rows[: 7 * BLOCK], end - begin, S)
        add_outer_products_numba(rows[7 * BLOCK :], end - begin, S)
    return cost, inliers


@njit(cache=True, nogil=True)
@no_type_check
def add_outer_products_numba(rows, count, S):  # (k BLOCK,), (k, k): lower triangle of S += rows rows^T
    """Sum of outer products over one block of columns; columns from `count` on are taken as zero."""
    k = len(S)
    for i in range(k):
        for c in range(count, BLOCK):
            rows[i * BLOCK + c] = 0.0
    for i in range(k):
        for j in range(i + 1):
            S[i, j] += block_dot(rows, i * BLOCK, j * BLOCK)


@njit(cache=True, nogil=True)
@no_type_check
def refine_pose_numba(pose, data, threshold2, softness, tolerance, max_steps):  # changes pose (12,) -> cost, inliers
    """Levenberg-Marquardt on the robust reprojection error, in place; the cost never rises.

    Ends when a step gains less than `tolerance` of the cost, or is too short to matter.
    """
    S, S_new, L, step = np.empty((7, 7)), np.empty((7, 7)), np.empty((6, 6)), np.empty(6)
    candidate, rows = np.empty(12), np.empty(14 * BLOCK)
    cost, inliers = pose_normal_equations_numba(pose, data, threshold2, softness, rows, S)
    damping = 1e-6
    for _ in range(max_steps):
        if not solve_damped_numba(S, damping, L, step):
            break
        if squared_length_numba(step) < MIN_STEP2:
            break
        _move_pose(pose, step, candidate)
        new_cost, new_inliers = pose_normal_equations_numba(candidate, data, threshold2, softness, rows, S_new)
        if new_cost < cost:
            gain = cost - new_cost
            copy_row_numba(candidate, pose)
            cost, inliers = new_cost, new_inliers
            S, S_new = S_new, S
            damping = max(damping * 0.1, 1e-12)
            if gain <= tolerance * cost:
                break
        else:
            damping = max(damping * 10.0, 1e-6)
            if damping > 1e2:
                break
    return cost, inliers


@njit(cache=True, nogil=True)
@no_type_check
def _move_pose(pose, step, out):
    """out = exp(omega) pose + v, with step = (omega, v)."""
    Q = np.empty(9)
    rotation_exp_numba(step[0], step[1], step[2], Q)
    multiply3_numba(Q, pose, out)
    for i in range(3):
        out[9 + i] = Q[3 * i] * pose[9] + Q[3 * i + 1] * pose[10] + Q[3 * i + 2] * pose[11] + step[3 + i]
