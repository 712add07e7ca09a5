"""Compiled refinement of single points: Levenberg-Marquardt on three unknowns each."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.bundle.linearize_numba import linearize_points_numba
from fieldstone.solve.bundle.schur_numba import inverse_cholesky_numba

START_DAMPING = 1e-4
MAX_DAMPING = 1e8


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def refine_points_numba(
    start, stop, view, point_start, pixels, scale_of_view, camera_of_view, model, active, num_active,
    R, t, points, params, loss, scale2, max_iterations, tolerance, free_point,
    B, residual, J_camera, V, g_point, cost, trial, V_trial, g_trial, cost_trial,
):  # fmt: skip
    """Move every free point (in place) to the least cost, cameras held; `cost` (p,) is the cost there.

    A point goes its own way: own damping, own end. Steps that lead behind a camera cost infinity and are not taken.
    """
    for p in range(start, stop):
        linearize_points_numba(
            p, p + 1, view, point_start, pixels, scale_of_view, camera_of_view, model, active, num_active,
            R, t, points, params, loss, scale2, B, residual, J_camera, V, g_point, cost,
        )  # fmt: skip
        damping = START_DAMPING
        iterations = max_iterations if free_point[p] and cost[p] < np.inf else 0
        for _ in range(iterations):
            grow = 1.0 + damping
            a0, a1, a2, a3, a4, a5 = inverse_cholesky_numba(
                V[p, 0] * grow, V[p, 1], V[p, 2] * grow, V[p, 3], V[p, 4], V[p, 5] * grow
            )
            y0 = a0 * g_point[p, 0]
            y1 = a1 * g_point[p, 0] + a2 * g_point[p, 1]
            y2 = a3 * g_point[p, 0] + a4 * g_point[p, 1] + a5 * g_point[p, 2]
            trial[p, 0] = points[p, 0] - (a0 * y0 + a1 * y1 + a3 * y2)
            trial[p, 1] = points[p, 1] - (a2 * y1 + a4 * y2)
            trial[p, 2] = points[p, 2] - a5 * y2
            linearize_points_numba(
                p, p + 1, view, point_start, pixels, scale_of_view, camera_of_view, model, active, num_active,
                R, t, trial, params, loss, scale2, B, residual, J_camera, V_trial, g_trial, cost_trial,
            )  # fmt: skip
            decrease = cost[p] - cost_trial[p]
            if decrease > 0.0:
                for k in range(3):
                    points[p, k] = trial[p, k]
                    g_point[p, k] = g_trial[p, k]
                for k in range(6):
                    V[p, k] = V_trial[p, k]
                settled = decrease <= tolerance * cost[p]
                cost[p] = cost_trial[p]
                damping *= 0.1
                if settled:
                    break
            else:
                damping *= 10.0
                # The linear model promises at most |y|^2 / 2: nothing is left to gain.
                if damping > MAX_DAMPING or y0 * y0 + y1 * y1 + y2 * y2 <= tolerance * cost[p]:
                    break
