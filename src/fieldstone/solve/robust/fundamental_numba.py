"""Fundamental matrices: refinement on the matrices of rank two, and plane-and-parallax hypotheses.

A state is a row of 12 numbers of which the first nine are F, row by row, |F| = 1.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.algebra.block_sums_numba import BLOCK
from fieldstone.solve.algebra.null_space_numba import null_space_numba
from fieldstone.solve.algebra.small_linear_numba import solve_damped_numba, squared_length_numba
from fieldstone.solve.robust.epipolar_numba import epipolar_normal_equations_numba
from fieldstone.solve.robust.essential_numba import project_normal_equations_numba
from fieldstone.solve.robust.reprojection_numba import MIN_STEP2

RANK_STEPS = 3


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def epipoles_numba(F, e1, e2):  # (9,) -> fills e1, e2 (3,) with F e1 ~ 0 and e2^T F ~ 0
    """Null vectors of a matrix of rank two (unit length): the longest row and column of its adjugate."""
    A = np.empty((3, 3))
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            # Cofactor of F_ij; the adjugate e1 e2^T is the transposed.
            A[j, i] = F[3 * p + k] * F[3 * q + m] - F[3 * p + m] * F[3 * q + k]
    row, col, best_row, best_col = 0, 0, -1.0, -1.0
    for i in range(3):
        length2 = A[i, 0] ** 2 + A[i, 1] ** 2 + A[i, 2] ** 2
        if length2 > best_row:
            best_row, row = length2, i
        length2 = A[0, i] ** 2 + A[1, i] ** 2 + A[2, i] ** 2
        if length2 > best_col:
            best_col, col = length2, i
    h, g = 1.0 / np.sqrt(max(best_col, 1e-300)), 1.0 / np.sqrt(max(best_row, 1e-300))
    for i in range(3):
        e1[i], e2[i] = A[i, col] * h, A[row, i] * g


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def set_rank_two_numba(F, e1, e2):  # changes F (>= 9,); e1, e2 (3,) out
    """Take the smallest singular part out of F, scale it to |F| = 1, and give its epipoles.

    F - (e2^T F e1) e2 e1^T with the approximate null vectors of the adjugate; each pass squares what is left.
    """
    for _ in range(RANK_STEPS):
        epipoles_numba(F, e1, e2)
        rest = 0.0
        for i in range(3):
            for j in range(3):
                rest += e2[i] * F[3 * i + j] * e1[j]
        for i in range(3):
            for j in range(3):
                F[3 * i + j] -= rest * e2[i] * e1[j]
    norm2 = 0.0
    for i in range(9):
        norm2 += F[i] * F[i]
    h = 1.0 / np.sqrt(norm2)
    for i in range(9):
        F[i] *= h


@njit(cache=True, nogil=True)
@no_type_check
def _rank_two_tangent(F, e1, e2, tangent):  # fills tangent (7, 9)
    """Orthonormal directions that keep the rank two and the scale: orthogonal to F and to e2 e1^T."""
    A, N = np.empty((9, 2)), np.empty((9, 7))
    for i in range(3):
        for j in range(3):
            A[3 * i + j, 0] = F[3 * i + j]
            A[3 * i + j, 1] = e2[i] * e1[j]
    null_space_numba(A, N)
    for i in range(9):
        for k in range(7):
            tangent[k, i] = N[i, k]


@njit(cache=True, nogil=True)
@no_type_check
def refine_fundamental_numba(F, data, threshold2, softness, tolerance, max_steps):  # changes F (>= 9,)
    """Levenberg-Marquardt on the robust Sampson error over the seven degrees of freedom of F, in place.

    The cost never rises. Returns cost and inliers.
    """
    rows, e1, e2, candidate = np.empty(10 * BLOCK), np.empty(3), np.empty(3), np.empty(9)
    S, S_new, H = np.empty((10, 10)), np.empty((10, 10)), np.empty((8, 8))
    L, step, tangent = np.empty((7, 7)), np.empty(7), np.empty((7, 9))
    set_rank_two_numba(F, e1, e2)
    cost, inliers = epipolar_normal_equations_numba(F, data, threshold2, softness, rows, S)
    damping = 1e-6
    for _ in range(max_steps):
        epipoles_numba(F, e1, e2)
        _rank_two_tangent(F, e1, e2, tangent)
        project_normal_equations_numba(S, tangent, H)
        if not solve_damped_numba(H, damping, L, step):
            break
        if squared_length_numba(step) < MIN_STEP2:
            break
        for i in range(9):
            candidate[i] = F[i]
            for k in range(7):
                candidate[i] += step[k] * tangent[k, i]
        set_rank_two_numba(candidate, e1, e2)
        new_cost, new_inliers = epipolar_normal_equations_numba(candidate, data, threshold2, softness, rows, S_new)
        if new_cost < cost:
            gain = cost - new_cost
            for i in range(9):
                F[i] = candidate[i]
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


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def plane_and_parallax_numba(a, b, H, models):  # (>= 2, 3), (>= 2, 3), (9,) -> count; fills models[0, :9]
    """F = [e2]_x H from a homography and two matches off its plane.

    A match off the plane lies on the line through the epipole and its transferred point, H x: two lines meet in e2.

    Source:
        `chum2005b`, section 3.1; `hartley2004`, section 13.4.
    """
    lines = np.empty((2, 3))
    for k in range(2):
        p1 = H[0] * a[k, 0] + H[1] * a[k, 1] + H[2] * a[k, 2]
        p2 = H[3] * a[k, 0] + H[4] * a[k, 1] + H[5] * a[k, 2]
        p3 = H[6] * a[k, 0] + H[7] * a[k, 1] + H[8] * a[k, 2]
        lines[k, 0] = b[k, 1] * p3 - b[k, 2] * p2
        lines[k, 1] = b[k, 2] * p1 - b[k, 0] * p3
        lines[k, 2] = b[k, 0] * p2 - b[k, 1] * p1
    c1 = lines[0, 1] * lines[1, 2] - lines[0, 2] * lines[1, 1]
    c2 = lines[0, 2] * lines[1, 0] - lines[0, 0] * lines[1, 2]
    c3 = lines[0, 0] * lines[1, 1] - lines[0, 1] * lines[1, 0]
    norm2 = c1 * c1 + c2 * c2 + c3 * c3
    if not norm2 > 1e-24 * squared_length_numba(lines[0]) * squared_length_numba(lines[1]):
        return 0
    norm2 = 0.0
    for j in range(3):
        models[0, j] = c2 * H[6 + j] - c3 * H[3 + j]
        models[0, 3 + j] = c3 * H[j] - c1 * H[6 + j]
        models[0, 6 + j] = c1 * H[3 + j] - c2 * H[j]
    for i in range(9):
        norm2 += models[0, i] ** 2
    h = 1.0 / np.sqrt(norm2)
    for i in range(9):
        models[0, i] *= h
    return 1
