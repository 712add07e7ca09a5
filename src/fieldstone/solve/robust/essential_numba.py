"""Essential matrices as (R, t): local refinement of the truncated Sampson error, poses, cheirality.

A state is a row of 12 numbers: R row by row, then t with |t| = 1, `cam2_from_cam1`; E = [t]_x R.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.algebra.block_sums_numba import BLOCK
from fieldstone.solve.algebra.small_linear_numba import (
    copy_row_numba,
    multiply3_numba,
    rotation_exp_numba,
    solve_damped_numba,
    squared_length_numba,
)
from fieldstone.solve.robust.epipolar_numba import epipolar_normal_equations_numba
from fieldstone.solve.robust.reprojection_numba import MIN_STEP2


@njit(cache=True, nogil=True)
@no_type_check
def essential_from_state_numba(state, E):  # (12,) -> fills E (9,)
    """E = [t]_x R."""
    t1, t2, t3 = state[9], state[10], state[11]
    for j in range(3):
        a, b, c = state[j], state[3 + j], state[6 + j]
        E[j], E[3 + j], E[6 + j] = t2 * c - t3 * b, t3 * a - t1 * c, t1 * b - t2 * a


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def state_from_essential_numba(E, state):  # (9,) -> fills state (12,); one of the four poses
    """R and t of E without a singular value decomposition.

    t is the longest cross product of two columns of E; with |E| = sqrt(2), R = cofactor(E) - [t]_x E. The other
    three poses are (R, -t) and (2 t t^T - I) R with either t.

    Source:
        `horn1990`.
    """
    norm2 = 0.0
    for i in range(9):
        norm2 += E[i] * E[i]
    s = np.sqrt(2.0 / norm2)
    best = 0.0
    t1, t2, t3 = 0.0, 0.0, 1.0
    for j in range(3):
        p, q = (j + 1) % 3, (j + 2) % 3
        c1 = E[3 + p] * E[6 + q] - E[6 + p] * E[3 + q]
        c2 = E[6 + p] * E[q] - E[p] * E[6 + q]
        c3 = E[p] * E[3 + q] - E[3 + p] * E[q]
        length2 = c1 * c1 + c2 * c2 + c3 * c3
        if length2 > best:
            best = length2
            h = 1.0 / np.sqrt(length2)
            t1, t2, t3 = c1 * h, c2 * h, c3 * h
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            cofactor = E[3 * p + k] * E[3 * q + m] - E[3 * p + m] * E[3 * q + k]
            state[3 * i + j] = s * s * cofactor
    for j in range(3):
        state[j] -= s * (t2 * E[6 + j] - t3 * E[3 + j])
        state[3 + j] -= s * (t3 * E[j] - t1 * E[6 + j])
        state[6 + j] -= s * (t1 * E[3 + j] - t2 * E[j])
    state[9], state[10], state[11] = t1, t2, t3


@njit(cache=True, nogil=True)
@no_type_check
def other_rotation_numba(state):
    """Replace R by (2 t t^T - I) R, the other rotation with the same E up to sign."""
    t1, t2, t3 = state[9], state[10], state[11]
    for j in range(3):
        dot = 2.0 * (t1 * state[j] + t2 * state[3 + j] + t3 * state[6 + j])
        state[j], state[3 + j], state[6 + j] = (
            dot * t1 - state[j],
            dot * t2 - state[3 + j],
            dot * t3 - state[6 + j],
        )


@njit(cache=True, nogil=True)
@no_type_check
def signs_of_depths_numba(state, x, y, x2, y2):  # -> numbers with the signs of the depths in camera 1 and camera 2
    """Depths of the point at which the rays of one match come nearest to each other, up to positive factors."""
    a1 = state[0] * x + state[1] * y + state[2]
    a2 = state[3] * x + state[4] * y + state[5]
    a3 = state[6] * x + state[7] * y + state[8]
    t1, t2, t3 = state[9], state[10], state[11]
    aa, bb = a1 * a1 + a2 * a2 + a3 * a3, x2 * x2 + y2 * y2 + 1.0
    ab, at, bt = a1 * x2 + a2 * y2 + a3, a1 * t1 + a2 * t2 + a3 * t3, x2 * t1 + y2 * t2 + t3
    # lambda1 R x + t = lambda2 y in the least-squares sense; the determinant aa bb - ab^2 is not negative.
    return ab * bt - bb * at, aa * bt - ab * at


@njit(cache=True, nogil=True)
@no_type_check
def consistent_sample_numba(E, data, sample, state):
    """Whether one of the four poses of E puts all matches of a sample in front of both cameras; state becomes it."""
    state_from_essential_numba(E, state)
    for attempt in range(2):
        for sign in (1.0, -1.0):
            good = True
            for i in range(len(sample)):
                k = sample[i]
                d1, d2 = signs_of_depths_numba(state, data[0, k], data[1, k], data[2, k], data[3, k])
                if not (sign * d1 > 0.0 and sign * d2 > 0.0):
                    good = False
                    break
            if good:
                state[9], state[10], state[11] = sign * state[9], sign * state[10], sign * state[11]
                return True
        if attempt == 0:
            other_rotation_numba(state)
    return False


@njit(cache=True, nogil=True)
@no_type_check
def refine_essential_numba(
    state, data, threshold2, softness, tolerance, max_steps
):  # changes state (12,) -> cost, inliers
    """Levenberg-Marquardt on the robust Sampson error over the five degrees of freedom of E, in place.

    Tangent: omega on the right of R, and two directions orthogonal to t. The cost never rises.
    Ends when a step gains less than `tolerance` of the cost, or is too short to matter. Returns cost and inliers.
    """
    E, rows = np.empty(9), np.empty(10 * BLOCK)
    S, S_new, H = np.empty((10, 10)), np.empty((10, 10)), np.empty((6, 6))
    L, step, candidate, tangent = np.empty((5, 5)), np.empty(5), np.empty(12), np.empty((5, 9))
    essential_from_state_numba(state, E)
    cost, inliers = epipolar_normal_equations_numba(E, data, threshold2, softness, rows, S)
    damping = 1e-6
    for _ in range(max_steps):
        _essential_tangent(state, E, tangent)
        project_normal_equations_numba(S, tangent, H)
        if not solve_damped_numba(H, damping, L, step):
            break
        if squared_length_numba(step) < MIN_STEP2:
            break
        _move_essential(state, step, candidate)
        essential_from_state_numba(candidate, E)
        new_cost, new_inliers = epipolar_normal_equations_numba(E, data, threshold2, softness, rows, S_new)
        if new_cost < cost:
            gain = cost - new_cost
            copy_row_numba(candidate, state)
            cost, inliers = new_cost, new_inliers
            S, S_new = S_new, S
            damping = max(damping * 0.1, 1e-12)
            if gain <= tolerance * cost:
                break
        else:
            damping = max(damping * 10.0, 1e-6)
            if damping > 1e2:
                break
            essential_from_state_numba(state, E)
    return cost, inliers


@njit(cache=True, nogil=True)
@no_type_check
def project_normal_equations_numba(S, tangent, H):  # (10, 10), (k, 9) -> fills the lower triangle of H (k + 1, k + 1)
    """H = T S T^T and, in its last row, T S_r, where the rows of T are derivatives of the nine matrix entries."""
    k = len(tangent)
    row = np.empty(9)
    for a in range(k):
        gradient = 0.0
        for j in range(9):
            gradient += tangent[a, j] * S[9, j]
            dot = 0.0
            for i in range(9):
                dot += tangent[a, i] * S[i, j]
            row[j] = dot
        H[k, a] = gradient
        for b in range(a + 1):
            dot = 0.0
            for j in range(9):
                dot += row[j] * tangent[b, j]
            H[a, b] = dot


@njit(cache=True, nogil=True)
@no_type_check
def _essential_tangent(state, E, tangent):  # fills tangent (5, 9)
    """dE = E [omega]_x for the rotation; dE = [b]_x R for two directions b orthogonal to t."""
    for i in range(3):
        e1, e2, e3 = E[3 * i], E[3 * i + 1], E[3 * i + 2]
        tangent[0, 3 * i], tangent[0, 3 * i + 1], tangent[0, 3 * i + 2] = 0.0, e3, -e2
        tangent[1, 3 * i], tangent[1, 3 * i + 1], tangent[1, 3 * i + 2] = -e3, 0.0, e1
        tangent[2, 3 * i], tangent[2, 3 * i + 1], tangent[2, 3 * i + 2] = e2, -e1, 0.0
    moved = np.empty(12)
    copy_row_numba(state, moved)
    b1, b2, b3, c1, c2, c3 = _orthogonal_directions(state[9], state[10], state[11])
    moved[9], moved[10], moved[11] = b1, b2, b3
    essential_from_state_numba(moved, tangent[3])
    moved[9], moved[10], moved[11] = c1, c2, c3
    essential_from_state_numba(moved, tangent[4])


@njit(cache=True, nogil=True)
@no_type_check
def _orthogonal_directions(t1, t2, t3):
    """Two unit vectors orthogonal to a unit vector and to each other."""
    if abs(t1) <= abs(t2) and abs(t1) <= abs(t3):
        h = 1.0 / np.sqrt(t2 * t2 + t3 * t3)
        b1, b2, b3 = 0.0, t3 * h, -t2 * h
    elif abs(t2) <= abs(t3):
        h = 1.0 / np.sqrt(t1 * t1 + t3 * t3)
        b1, b2, b3 = -t3 * h, 0.0, t1 * h
    else:
        h = 1.0 / np.sqrt(t1 * t1 + t2 * t2)
        b1, b2, b3 = t2 * h, -t1 * h, 0.0
    return b1, b2, b3, t2 * b3 - t3 * b2, t3 * b1 - t1 * b3, t1 * b2 - t2 * b1


@njit(cache=True, nogil=True)
@no_type_check
def _move_essential(state, step, out):
    """out = (R exp(omega), t + two tangent steps, normalised)."""
    Q = np.empty(9)
    rotation_exp_numba(step[0], step[1], step[2], Q)
    multiply3_numba(state, Q, out)
    b1, b2, b3, c1, c2, c3 = _orthogonal_directions(state[9], state[10], state[11])
    t1 = state[9] + step[3] * b1 + step[4] * c1
    t2 = state[10] + step[3] * b2 + step[4] * c2
    t3 = state[11] + step[3] * b3 + step[4] * c3
    h = 1.0 / np.sqrt(t1 * t1 + t2 * t2 + t3 * t3)
    out[9], out[10], out[11] = t1 * h, t2 * h, t3 * h


@njit(cache=True, nogil=True)
@no_type_check
def choose_pose_numba(state, data, inliers):  # changes state (12,) and inliers (n,) -> number of inliers
    """Of the four poses of E, the one with most inliers in front of both cameras; only these stay inliers.

    Source:
        `hartley2004`, section 9.6.3.
    """
    best = np.empty(12)
    n = data.shape[1]
    best_count = -1
    for attempt in range(2):
        both_positive, both_negative = 0, 0
        for i in range(n):
            if inliers[i]:
                d1, d2 = signs_of_depths_numba(state, data[0, i], data[1, i], data[2, i], data[3, i])
                both_positive += d1 > 0.0 and d2 > 0.0
                both_negative += d1 < 0.0 and d2 < 0.0
        for count, sign in ((both_positive, 1.0), (both_negative, -1.0)):
            if count > best_count:
                best_count = count
                copy_row_numba(state, best)
                best[9], best[10], best[11] = sign * state[9], sign * state[10], sign * state[11]
        if attempt == 0:
            other_rotation_numba(state)
    copy_row_numba(best, state)
    for i in range(n):
        if inliers[i]:
            d1, d2 = signs_of_depths_numba(state, data[0, i], data[1, i], data[2, i], data[3, i])
            inliers[i] = d1 > 0.0 and d2 > 0.0
    return best_count
