"""The reduced camera system times a vector, without the system: through the points and back."""

from __future__ import annotations

from typing import no_type_check

from numba import njit

from fieldstone.solve.bundle.schur_numba import views_of_point_numba


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def points_of_views_numba(start, stop, layout, values, Z, x, w):
    """w (p, 3) = sum of Z_i x_i over the free views i of each point from `start` to `stop`; x (s, block)."""
    point_start, free_index, pivot, points = layout.point_start, layout.free_index, layout.pivot, values.points
    for p in range(start, stop):
        d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
        first, end = point_start[p], point_start[p + 1]
        w[p, 0], w[p, 1], w[p, 2] = views_of_point_numba(first, end, d0, d1, d2, free_index, Z, x)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def views_of_points_numba(start, stop, layout, values, Z, U, damping, x, w, out):
    """out (s, block) = (U_i + damping diag U_i) x_i - sum of Z_i^T w over the points of each free view."""
    view_start, view_obs, point, free_point = layout.view_start, layout.view_obs, layout.point_of_obs, layout.free_point
    pivot, points = layout.pivot, values.points
    block = U.shape[1]
    for i in range(start, stop):
        for a in range(block):
            total = damping * U[i, a, a] * x[i, a]
            for b in range(block):
                total += U[i, a, b] * x[i, b]
            out[i, a] = total
        for m in range(view_start[i], view_start[i + 1]):
            o = view_obs[m]
            p = point[o]
            if not free_point[p]:
                continue
            d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
            w0, w1, w2 = w[p, 0], w[p, 1], w[p, 2]
            h0 = Z[o, 0, 0] * w0 + Z[o, 1, 0] * w1 + Z[o, 2, 0] * w2
            h1 = Z[o, 0, 1] * w0 + Z[o, 1, 1] * w1 + Z[o, 2, 1] * w2
            h2 = Z[o, 0, 2] * w0 + Z[o, 1, 2] * w1 + Z[o, 2, 2] * w2
            out[i, 0] -= d1 * h2 - d2 * h1
            out[i, 1] -= d2 * h0 - d0 * h2
            out[i, 2] -= d0 * h1 - d1 * h0
            out[i, 3] -= h0
            out[i, 4] -= h1
            out[i, 5] -= h2
            for a in range(3, Z.shape[2]):
                out[i, 3 + a] -= Z[o, 0, a] * w0 + Z[o, 1, a] * w1 + Z[o, 2, a] * w2
