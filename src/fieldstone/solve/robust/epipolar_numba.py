"""Sampson error of one epipolar matrix: score with early rejection, normal equations.

Matches are rows of one array `data` (6, n): x1, y1 and x2, y2, coordinates on the plane z = 1 (or any plane), and
v1, v2, the squared size of a pixel of each photo in these coordinates: the error then is in pixels,

r = C / sqrt(v2 (p_1^2 + p_2^2) + v1 (q_1^2 + q_2^2)),  C = y^T M x,  p = M x,  q = M^T y.

The score is the truncated sum of squares (MSAC), sum_i min(r_i^2, threshold^2), of `torr2000`.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.algebra.block_sums_numba import BLOCK, block_sum
from fieldstone.solve.robust.reprojection_numba import add_outer_products_numba


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _score_block(M, data, begin, end, threshold2, costs):  # -> truncated cost, inliers of data[:, begin:end]
    """`costs` (BLOCK,) is room for those of the matches."""
    m1, m2, m3, m4, m5, m6, m7, m8, m9 = M[0], M[1], M[2], M[3], M[4], M[5], M[6], M[7], M[8]
    x1, y1, x2, y2 = data[0, begin:end], data[1, begin:end], data[2, begin:end], data[3, begin:end]
    v1, v2 = data[4, begin:end], data[5, begin:end]
    inliers = 0
    for i in range(len(x1)):
        p1 = m1 * x1[i] + m2 * y1[i] + m3
        p2 = m4 * x1[i] + m5 * y1[i] + m6
        p3 = m7 * x1[i] + m8 * y1[i] + m9
        q1 = m1 * x2[i] + m4 * y2[i] + m7
        q2 = m2 * x2[i] + m5 * y2[i] + m8
        C = x2[i] * p1 + y2[i] * p2 + p3
        C2 = C * C
        D = v2[i] * (p1 * p1 + p2 * p2) + v1[i] * (q1 * q1 + q2 * q2)
        good = threshold2 * D > C2
        costs[i] = C2 / D if good else threshold2
        inliers += 1 if good else 0
    costs[len(x1) :] = 0.0
    return block_sum(costs, 0), inliers


@njit(cache=True, nogil=True)
@no_type_check
def score_epipolar_numba(M, data, threshold2, max_cost, early_test):
    """Truncated cost, inliers and matches looked at; the cost is inf where M was rejected before the end.

    As `reprojection_numba.score_pose_numba`.
    """
    n = data.shape[1]
    cost, inliers = 0.0, 0.0
    costs = np.empty(BLOCK)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        block_cost, block_inliers = _score_block(M, data, begin, end, threshold2, costs)
        cost += block_cost
        inliers += block_inliers
        log_ratio = inliers * early_test.gain_in + (end - inliers) * early_test.gain_out
        if end < n and (cost > max_cost or log_ratio > early_test.log_limit):
            return np.inf, inliers, end
    return cost, inliers, n


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _derivatives_block(M, data, begin, end, threshold2, softness, rows, costs):  # fills rows (10 BLOCK,)
    """Weighted derivatives of the Sampson error by the entries of M, zero for outliers, then the error.

    Rows are pieces of one flat array, so that the loop runs in vectors. Returns cost and inliers.
    """
    m1, m2, m3, m4, m5, m6, m7, m8, m9 = M[0], M[1], M[2], M[3], M[4], M[5], M[6], M[7], M[8]
    x1, y1, x2, y2 = data[0, begin:end], data[1, begin:end], data[2, begin:end], data[3, begin:end]
    v1, v2 = data[4, begin:end], data[5, begin:end]
    outlier_cost = threshold2 / (1.0 + softness * threshold2)
    inliers = 0
    for i in range(len(x1)):
        a1, b1, a2, b2 = x1[i], y1[i], x2[i], y2[i]
        p1, p2, p3 = m1 * a1 + m2 * b1 + m3, m4 * a1 + m5 * b1 + m6, m7 * a1 + m8 * b1 + m9
        q1, q2 = m1 * a2 + m4 * b2 + m7, m2 * a2 + m5 * b2 + m8
        C = a2 * p1 + b2 * p2 + p3
        D = v2[i] * (p1 * p1 + p2 * p2) + v1[i] * (q1 * q1 + q2 * q2)
        good = threshold2 * D > C * C
        s2 = 1.0 / (D if good else 1.0)
        weight = 1.0 / (1.0 + softness * C * C * s2)
        costs[i] = C * C * s2 * weight if good else outlier_cost
        inliers += 1 if good else 0
        s = np.sqrt(s2) * weight if good else 0.0
        # dr/dM = (y x^T - (C / D) (v2 (p1, p2, 0) x^T + v1 y (q1, q2, 0)^T)) / sqrt(D)
        k = C * s2
        left1, left2 = s * (a2 - k * v2[i] * p1), s * (b2 - k * v2[i] * p2)
        right1, right2 = s * k * v1[i] * q1, s * k * v1[i] * q2
        rows[i] = left1 * a1 - a2 * right1
        rows[BLOCK + i] = left1 * b1 - a2 * right2
        rows[2 * BLOCK + i] = left1
        rows[3 * BLOCK + i] = left2 * a1 - b2 * right1
        rows[4 * BLOCK + i] = left2 * b1 - b2 * right2
        rows[5 * BLOCK + i] = left2
        rows[6 * BLOCK + i] = s * a1 - right1
        rows[7 * BLOCK + i] = s * b1 - right2
        rows[8 * BLOCK + i] = s
        rows[9 * BLOCK + i] = C * s
    costs[len(x1) :] = 0.0
    return block_sum(costs, 0), inliers


@njit(cache=True, nogil=True)
@no_type_check
def epipolar_normal_equations_numba(M, data, threshold2, softness, rows, S):  # fills S (10, 10) -> cost, inliers
    """S = sum over inliers of w (dr/dM, r) (dr/dM, r)^T: every parametrisation of M needs only this 10x10 matrix.

    The cost of a match is rho(min(r^2, threshold^2)) with rho(s) = s / (1 + softness s), w = rho'(r^2): plain
    truncated squares for softness 0, and the loss of Geman and McClure with scale c for softness 1 / c^2.
    """
    n = data.shape[1]
    for i in range(10):
        for j in range(10):
            S[i, j] = 0.0
    cost, inliers = 0.0, 0.0
    costs = np.empty(BLOCK)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        block_cost, block_inliers = _derivatives_block(M, data, begin, end, threshold2, softness, rows, costs)
        cost += block_cost
        inliers += block_inliers
        add_outer_products_numba(rows, end - begin, S)
    for i in range(10):
        for j in range(i):
            S[j, i] = S[i, j]
    return cost, inliers


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def epipolar_errors_numba(M, data, errors):  # fills errors (n,)
    """Squared Sampson error in pixels of every match; 0 for a match at both epipoles."""
    for i in range(data.shape[1]):
        x1, y1, x2, y2 = data[0, i], data[1, i], data[2, i], data[3, i]
        p1, p2, p3 = M[0] * x1 + M[1] * y1 + M[2], M[3] * x1 + M[4] * y1 + M[5], M[6] * x1 + M[7] * y1 + M[8]
        q1, q2 = M[0] * x2 + M[3] * y2 + M[6], M[1] * x2 + M[4] * y2 + M[7]
        C = x2 * p1 + y2 * p2 + p3
        D = data[5, i] * (p1 * p1 + p2 * p2) + data[4, i] * (q1 * q1 + q2 * q2)
        errors[i] = C * C / (D if D > 1e-300 else 1e-300)
