"""Compiled linearisation of the reprojection error: residuals, Jacobians, and the blocks of the normal equations.

Every kernel works on a range of points or views, writes only what belongs to that range, and adds in a fixed order.
Ranges can therefore run in any number of threads, and the result has the same bits. `problem.py` holds the
readable reference of the residuals and Jacobians, `schur.py` that of the normal equations.

Notation, for an observation: B (2, 3) is the derivative of the residual by the point; the pose Jacobian has the row
[d x b, b] for every row b of B, with d = point - pivot, the centre about which poses are turned.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.solve.projection.projection_numba import MAX_COEFFICIENTS, image_from_cam_numba, robust_numba


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def linearize_points_numba(start, stop, layout, values, loss, out):
    """Weighted residuals, B, J_camera, V (lower), g_point and cost of the points `start` to `stop`, into `out`.

    `loss` holds the number of the loss and its squared scale. The cost of a point that is behind one of its cameras
    is infinite, and the rest of it is left undefined.
    """
    view, point_start = layout.view_of_obs, layout.point_start
    pixels, scale_of_view = layout.pixels, layout.scale_of_view
    camera_of_view, model = layout.camera_of_view, layout.model
    refined, num_refined = layout.refined, layout.num_refined
    R, t, points, params = values.R, values.t, values.points, values.params
    B, residual, J_camera, V, g_point, cost = out.B, out.residual, out.J_camera, out.V, out.g_point, out.cost
    loss_number, loss_scale2 = loss
    J = np.empty((2, 3))
    J_params = np.zeros((2, 12))
    J_k = np.zeros((2, MAX_COEFFICIENTS))
    for p in range(start, stop):
        X0, X1, X2 = points[p, 0], points[p, 1], points[p, 2]
        v00, v10, v11, v20, v21, v22, g0, g1, g2, total = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for o in range(point_start[p], point_start[p + 1]):
            v = view[o]
            c = camera_of_view[v]
            z = R[v, 2, 0] * X0 + R[v, 2, 1] * X1 + R[v, 2, 2] * X2 + t[v, 2]
            if not z > 0.0:
                total = np.inf
                break
            x = R[v, 0, 0] * X0 + R[v, 0, 1] * X1 + R[v, 0, 2] * X2 + t[v, 0]
            y = R[v, 1, 0] * X0 + R[v, 1, 1] * X1 + R[v, 1, 2] * X2 + t[v, 1]
            px, py = image_from_cam_numba(model[c], params[c], x, y, z, J, J_params, J_k)
            scale = scale_of_view[v]
            rx = (px - pixels[o, 0]) / scale
            ry = (py - pixels[o, 1]) / scale
            rho, weight = robust_numba(loss_number, loss_scale2, rx * rx + ry * ry)
            total += rho
            root = np.sqrt(weight)
            w = root / scale
            for row in range(2):
                a, b, e = w * J[row, 0], w * J[row, 1], w * J[row, 2]
                b0 = a * R[v, 0, 0] + b * R[v, 1, 0] + e * R[v, 2, 0]
                b1 = a * R[v, 0, 1] + b * R[v, 1, 1] + e * R[v, 2, 1]
                b2 = a * R[v, 0, 2] + b * R[v, 1, 2] + e * R[v, 2, 2]
                r = root * rx if row == 0 else root * ry
                v00 += b0 * b0
                v10 += b1 * b0
                v11 += b1 * b1
                v20 += b2 * b0
                v21 += b2 * b1
                v22 += b2 * b2
                g0 += b0 * r
                g1 += b1 * r
                g2 += b2 * r
                B[o, row, 0], B[o, row, 1], B[o, row, 2] = b0, b1, b2
                residual[o, row] = r
                for k in range(num_refined[c]):
                    J_camera[o, row, k] = w * J_params[row, refined[c, k]]
        V[p, 0], V[p, 1], V[p, 2], V[p, 3], V[p, 4], V[p, 5] = v00, v10, v11, v20, v21, v22
        g_point[p, 0], g_point[p, 1], g_point[p, 2] = g0, g1, g2
        cost[p] = 0.5 * total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def linearize_views_numba(start, stop, layout, values, at, buffers):
    """U_view and g_view: normal equations of pose and camera of the views `start` to `stop` of `view_order`."""
    view_start, view_obs, view_order, point = layout.view_start, layout.view_obs, layout.view_order, layout.point_of_obs
    camera_of_view, num_refined, pivot, points = layout.camera_of_view, layout.num_refined, layout.pivot, values.points
    B, residual, J_camera, U, g_view = at.B, at.residual, at.J_camera, buffers.U_view, buffers.g_view
    j0 = np.empty(U.shape[1])
    j1 = np.empty(U.shape[1])
    for i in range(start, stop):
        num_camera = num_refined[camera_of_view[view_order[i]]]
        size = 6 + num_camera
        for a in range(size):
            g_view[i, a] = 0.0
            for b in range(size):
                U[i, a, b] = 0.0
        for m in range(view_start[i], view_start[i + 1]):
            o = view_obs[m]
            p = point[o]
            d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
            for row in range(2):
                b0, b1, b2 = B[o, row, 0], B[o, row, 1], B[o, row, 2]
                j = j0 if row == 0 else j1
                j[0] = d1 * b2 - d2 * b1
                j[1] = d2 * b0 - d0 * b2
                j[2] = d0 * b1 - d1 * b0
                j[3] = b0
                j[4] = b1
                j[5] = b2
                for k in range(num_camera):
                    j[6 + k] = J_camera[o, row, k]
            r0, r1 = residual[o, 0], residual[o, 1]
            for a in range(size):
                a0, a1 = j0[a], j1[a]
                g_view[i, a] += a0 * r0 + a1 * r1
                for b in range(a + 1):
                    U[i, a, b] += a0 * j0[b] + a1 * j1[b]
        for a in range(size):
            for b in range(a):
                U[i, b, a] = U[i, a, b]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def gather_cameras_numba(layout, buffers, system):
    """Sort the normal equations of views into free views (U, g), shared intrinsics (corner, g_shared) and `cross`.

    Columns that no residual depends on become identity rows: they stay put.
    """
    U_view, g_view = buffers.U_view, buffers.g_view
    U, g, cross, corner, g_shared = system.U, system.g, system.cross, system.corner, system.g_shared
    block = U.shape[1]
    for i in range(len(layout.view_order)):
        c = layout.camera_of_view[layout.view_order[i]]
        first = layout.shared_row[c]
        per_view = layout.per_view[c]
        num_camera = layout.num_refined[c] if per_view or first >= 0 else 0
        if i < layout.num_free_views:
            used = 6 + num_camera if per_view else 6
            for a in range(block):
                g[i, a] = g_view[i, a] if a < used else 0.0
                for b in range(block):
                    U[i, a, b] = U_view[i, a, b] if a < used and b < used else 0.0
                if not U[i, a, a] > 0.0:
                    U[i, a, a] = 1.0
        if first >= 0:
            for a in range(num_camera):
                g_shared[first + a] += g_view[i, 6 + a]
                for b in range(num_camera):
                    corner[first + a, first + b] += U_view[i, 6 + a, 6 + b]
                if i < layout.num_free_views:
                    for b in range(6):
                        cross[first + a, i, b] = U_view[i, 6 + a, b]
    for a in range(len(g_shared)):
        if not corner[a, a] > 0.0:
            corner[a, a] = 1.0
