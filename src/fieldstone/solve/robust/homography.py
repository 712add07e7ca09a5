"""Homographies from four correspondences, their refinement, and the two motions of a plane's neighbours."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.solve.algebra.block_sums_numba import BLOCK, block_sum
from fieldstone.solve.algebra.null_space_numba import null_space_numba
from fieldstone.solve.algebra.small_linear_numba import (
    copy_row_numba,
    multiply3_numba,
    solve_damped_numba,
    squared_length_numba,
)
from fieldstone.solve.robust.reprojection_numba import MIN_STEP2, add_outer_products_numba

MIN_AREA = 1e-9


def homography_four_point(
    x1: Float[np.ndarray, "4 3"], x2: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "3 3"] | None:
    """The homography x2 ~ H x1 of four correspondences, |H| = 1 and det(H) > 0.

    Returns:
        None where three of the points lie on one line in either image, or where H turns the order of the points of
        a triangle around, which no view of a plane from its front does.

    Args:
        x1, x2: Homogeneous coordinates with z = 1.

    Source:
        `hartley2004`, section 4.1.
    """
    models = np.empty((1, 12))
    count = homography_numba(np.ascontiguousarray(x1, np.float64), np.ascontiguousarray(x2, np.float64), models)
    return models[0, :9].reshape(3, 3).copy() if count else None


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def homography_numba(a, b, models):  # (>= 4, 3), (>= 4, 3) -> count; fills models (>= 1, 12), first 9 of the row
    """`homography_four_point` into a preallocated row."""
    for k in range(4):
        p, q, r = (k + 1) % 4, (k + 2) % 4, (k + 3) % 4
        area1, area2 = _area(a, p, q, r), _area(b, p, q, r)
        if abs(area1) < MIN_AREA or abs(area2) < MIN_AREA or area1 * area2 < 0.0:
            return 0
    A, N = np.empty((9, 8)), np.empty((9, 1))
    for k in range(4):
        for j in range(3):
            A[j, 2 * k], A[3 + j, 2 * k], A[6 + j, 2 * k] = a[k, j], 0.0, -b[k, 0] * a[k, j]
            A[j, 2 * k + 1], A[3 + j, 2 * k + 1], A[6 + j, 2 * k + 1] = 0.0, a[k, j], -b[k, 1] * a[k, j]
    null_space_numba(A, N)
    H = models[0]
    for i in range(9):
        H[i] = N[i, 0]
    det = H[0] * (H[4] * H[8] - H[5] * H[7]) + H[1] * (H[5] * H[6] - H[3] * H[8]) + H[2] * (H[3] * H[7] - H[4] * H[6])
    if not abs(det) > 1e-12:
        return 0
    # x2 ~ H x1 with a positive factor, so that "in front" keeps its meaning.
    if H[6] * a[0, 0] + H[7] * a[0, 1] + H[8] < 0.0:
        for i in range(9):
            H[i] = -H[i]
    return 1


@njit(cache=True, nogil=True)
@no_type_check
def _area(x, p, q, r):
    """Twice the signed area of a triangle."""
    return (x[q, 0] - x[p, 0]) * (x[r, 1] - x[p, 1]) - (x[q, 1] - x[p, 1]) * (x[r, 0] - x[p, 0])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _derivatives_block(
    H, data, begin, end, threshold2, softness, rows, costs
):  # fills rows (12 BLOCK,), costs (BLOCK,)
    """Weighted derivatives of the transfer error by the eight entries of D in (I + D) H, D_33 = 0, then the error.

    `data` as for a pose (`reprojection_numba`), with the point (x1, y1, 1). u' = u + D_11 u + D_12 v + D_13 -
    u (D_31 u + D_32 v), and v' alike.
    """
    h1, h2, h3, h4, h5, h6, h7, h8, h9 = H[0], H[1], H[2], H[3], H[4], H[5], H[6], H[7], H[8]
    u_seen, v_seen = data[0, begin:end], data[1, begin:end]
    X, Y = data[2, begin:end], data[3, begin:end]
    w11, w22 = data[5, begin:end], data[7, begin:end]
    outlier_cost = threshold2 / (1.0 + softness * threshold2)
    inliers = 0
    for i in range(len(X)):
        z = h7 * X[i] + h8 * Y[i] + h9
        h = 1.0 / (z if z > 0.0 else 1.0)
        u, v = (h1 * X[i] + h2 * Y[i] + h3) * h, (h4 * X[i] + h5 * Y[i] + h6) * h
        r1, r2 = w11[i] * (u - u_seen[i]), w22[i] * (v - v_seen[i])
        error = r1 * r1 + r2 * r2
        good = (error < threshold2) & (z > 0.0)
        weight = 1.0 / (1.0 + softness * error)
        costs[i] = error * weight if good else outlier_cost
        inliers += 1 if good else 0
        s = weight if good else 0.0
        p, q = s * w11[i], s * w22[i]
        rows[i] = p * u
        rows[BLOCK + i] = p * v
        rows[2 * BLOCK + i] = p
        rows[3 * BLOCK + i] = -p * u * u
        rows[4 * BLOCK + i] = -p * u * v
        rows[5 * BLOCK + i] = s * r1
        rows[6 * BLOCK + i] = q * u
        rows[7 * BLOCK + i] = q * v
        rows[8 * BLOCK + i] = q
        rows[9 * BLOCK + i] = -q * u * v
        rows[10 * BLOCK + i] = -q * v * v
        rows[11 * BLOCK + i] = s * r2
    costs[len(X) :] = 0.0
    return block_sum(costs, 0), inliers


@njit(cache=True, nogil=True)
@no_type_check
def homography_normal_equations_numba(H, data, threshold2, softness, rows, S):  # fills lower S (9, 9) -> cost, inliers
    """Sum of w (J, r)^T (J, r) over inliers, tangent (D_11, D_12, D_13, D_21, D_22, D_23, D_31, D_32)."""
    P, Q = np.zeros((6, 6)), np.zeros((6, 6))
    cost, inliers = 0.0, 0.0
    n = data.shape[1]
    costs = np.empty(BLOCK)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        block_cost, block_inliers = _derivatives_block(H, data, begin, end, threshold2, softness, rows, costs)
        cost += block_cost
        inliers += block_inliers
        add_outer_products_numba(rows[: 6 * BLOCK], end - begin, P)
        add_outer_products_numba(rows[6 * BLOCK :], end - begin, Q)
    # Places of the six rows of u and of v in the tangent and the residual.
    for i in range(9):
        for j in range(9):
            S[i, j] = 0.0
    for i in range(6):
        for j in range(i + 1):
            iu, ju = (i if i < 3 else i + 3), (j if j < 3 else j + 3)
            S[iu, ju] += P[i, j]
            S[i + 3, j + 3] += Q[i, j]
    return cost, inliers


@njit(cache=True, nogil=True)
@no_type_check
def refine_homography_numba(H, data, threshold2, softness, tolerance, max_steps):  # changes H (>= 9,)
    """Levenberg-Marquardt on the robust transfer error, in place; the cost never rises. Returns cost and inliers."""
    S, S_new, L, step = np.empty((9, 9)), np.empty((9, 9)), np.empty((8, 8)), np.empty(8)
    candidate, D, rows = np.empty(12), np.empty(9), np.empty(12 * BLOCK)
    cost, inliers = homography_normal_equations_numba(H, data, threshold2, softness, rows, S)
    damping = 1e-6
    for _ in range(max_steps):
        if not solve_damped_numba(S, damping, L, step):
            break
        if squared_length_numba(step) < MIN_STEP2:
            break
        copy_row_numba(step, D)
        D[0], D[4], D[8] = 1.0 + D[0], 1.0 + D[4], 1.0
        multiply3_numba(D, H, candidate)
        new_cost, new_inliers = homography_normal_equations_numba(candidate, data, threshold2, softness, rows, S_new)
        if new_cost < cost:
            gain = cost - new_cost
            for i in range(9):
                H[i] = candidate[i]
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
