"""Compiled Schur complement of bundle adjustment; `schur.py` is the readable reference.

Every kernel works on a range of points or views, writes only what belongs to that range, and adds in a fixed order.
Ranges can therefore run in any number of threads, and the result has the same bits.

Notation, for observation o of point p by free view i (Cholesky: V + damping = L L^T, V the 3x3 block of p):
Z (3, block) = L^-1 B^T [pose Jacobian | Jacobian K of per-view intrinsics], with the Jacobians of `linearize_numba`, so
that the reduced system loses Z_i^T Z_j for every point that views i and j share. The rows of Z are [d x h, h, k] with
h = L^-1 B^T B and k = L^-1 B^T K: only [h, k] is stored, (3, block - 3), and the rotation's part d x h is made where it
is needed. Z_shared is the same for the shared intrinsics of a coupling, summed over its observations.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def mark_shared_tiles_numba(layout, per_tile, exists):
    """Set exists[I, J], J <= I, where a free point is seen by free views of tile I and of tile J."""
    point_start, free_index, free_point = layout.point_start, layout.free_index, layout.free_point
    for p in range(len(free_point)):
        if not free_point[p]:
            continue
        for o in range(point_start[p], point_start[p + 1]):
            for o2 in range(point_start[p], o + 1 if free_index[o] >= 0 else 0):
                if free_index[o2] >= 0:
                    exists[free_index[o] // per_tile, free_index[o2] // per_tile] = True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def eliminate_points_numba(start, stop, layout, at, damping, buffers):
    """L_inv (lower), y = L^-1 g, Z and Z_shared of the points `start` to `stop`, for V + damping diag(V).

    Held points, and points whose block is singular, get L_inv = 0: they do not move in this step.
    """
    view, free_index = layout.view_of_obs, layout.free_index
    point_start, free_point = layout.point_start, layout.free_point
    camera_of_view, num_refined, per_view = layout.camera_of_view, layout.num_refined, layout.per_view
    coupling_start, coupling_of_obs = layout.couplings.start, layout.couplings.of_obs
    B, J_camera, V, g_point = at.B, at.J_camera, at.V, at.g_point
    L_inv, y, Z, Z_shared = buffers.L_inv, buffers.y, buffers.Z, buffers.Z_shared
    grow = 1.0 + damping
    for p in range(start, stop):
        for e in range(coupling_start[p], coupling_start[p + 1]):
            for k in range(3):
                for a in range(Z_shared.shape[2]):
                    Z_shared[e, k, a] = 0.0
        a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if free_point[p]:
            a0, a1, a2, a3, a4, a5 = inverse_cholesky_numba(
                V[p, 0] * grow, V[p, 1], V[p, 2] * grow, V[p, 3], V[p, 4], V[p, 5] * grow
            )
        L_inv[p, 0], L_inv[p, 1], L_inv[p, 2], L_inv[p, 3], L_inv[p, 4], L_inv[p, 5] = a0, a1, a2, a3, a4, a5
        y[p, 0] = a0 * g_point[p, 0]
        y[p, 1] = a1 * g_point[p, 0] + a2 * g_point[p, 1]
        y[p, 2] = a3 * g_point[p, 0] + a4 * g_point[p, 1] + a5 * g_point[p, 2]
        for o in range(point_start[p], point_start[p + 1]):
            c = camera_of_view[view[o]]
            e = coupling_of_obs[o]
            is_free = free_index[o] >= 0
            if not is_free and e < 0:
                continue
            num_per_view = num_refined[c] if per_view[c] else 0
            for k in range(3):
                m0 = a0 if k == 0 else (a1 if k == 1 else a3)
                m1 = 0.0 if k == 0 else (a2 if k == 1 else a4)
                m2 = a5 if k == 2 else 0.0
                q0 = B[o, 0, 0] * m0 + B[o, 0, 1] * m1 + B[o, 0, 2] * m2
                q1 = B[o, 1, 0] * m0 + B[o, 1, 1] * m1 + B[o, 1, 2] * m2
                if is_free:
                    Z[o, k, 0] = q0 * B[o, 0, 0] + q1 * B[o, 1, 0]
                    Z[o, k, 1] = q0 * B[o, 0, 1] + q1 * B[o, 1, 1]
                    Z[o, k, 2] = q0 * B[o, 0, 2] + q1 * B[o, 1, 2]
                    for a in range(Z.shape[2] - 3):
                        Z[o, k, 3 + a] = q0 * J_camera[o, 0, a] + q1 * J_camera[o, 1, a] if a < num_per_view else 0.0
                if e >= 0:
                    for a in range(num_refined[c]):
                        Z_shared[e, k, a] += q0 * J_camera[o, 0, a] + q1 * J_camera[o, 1, a]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def inverse_cholesky_numba(v00, v10, v11, v20, v21, v22):
    """L^-1 (00, 10, 11, 20, 21, 22) of a symmetric 3x3 matrix L L^T; zeros if it is not positive definite."""
    if v00 > 0.0:
        l00 = np.sqrt(v00)
        l10 = v10 / l00
        l20 = v20 / l00
        s11 = v11 - l10 * l10
        if s11 > 0.0:
            l11 = np.sqrt(s11)
            l21 = (v21 - l20 * l10) / l11
            s22 = v22 - l20 * l20 - l21 * l21
            if s22 > 0.0:
                a0, a2, a5 = 1.0 / l00, 1.0 / l11, 1.0 / np.sqrt(s22)
                a1 = -l10 * a0 * a2
                return a0, a1, a2, -(l20 * a0 + l21 * a1) * a5, -l21 * a2 * a5, a5
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _subtract_pose_product_numba(d0, d1, d2, z, w, target):
    """target (6, 6) -= [d x z, z]^T [d x w, w] for the stored parts z, w of two observations of one point."""
    k00 = z[0, 0] * w[0, 0] + z[1, 0] * w[1, 0] + z[2, 0] * w[2, 0]
    k01 = z[0, 0] * w[0, 1] + z[1, 0] * w[1, 1] + z[2, 0] * w[2, 1]
    k02 = z[0, 0] * w[0, 2] + z[1, 0] * w[1, 2] + z[2, 0] * w[2, 2]
    k10 = z[0, 1] * w[0, 0] + z[1, 1] * w[1, 0] + z[2, 1] * w[2, 0]
    k11 = z[0, 1] * w[0, 1] + z[1, 1] * w[1, 1] + z[2, 1] * w[2, 1]
    k12 = z[0, 1] * w[0, 2] + z[1, 1] * w[1, 2] + z[2, 1] * w[2, 2]
    k20 = z[0, 2] * w[0, 0] + z[1, 2] * w[1, 0] + z[2, 2] * w[2, 0]
    k21 = z[0, 2] * w[0, 1] + z[1, 2] * w[1, 1] + z[2, 2] * w[2, 1]
    k22 = z[0, 2] * w[0, 2] + z[1, 2] * w[1, 2] + z[2, 2] * w[2, 2]
    for a in range(6):
        if a == 0:
            q0, q1, q2 = d1 * k20 - d2 * k10, d1 * k21 - d2 * k11, d1 * k22 - d2 * k12
        elif a == 1:
            q0, q1, q2 = d2 * k00 - d0 * k20, d2 * k01 - d0 * k21, d2 * k02 - d0 * k22
        elif a == 2:
            q0, q1, q2 = d0 * k10 - d1 * k00, d0 * k11 - d1 * k01, d0 * k12 - d1 * k02
        elif a == 3:
            q0, q1, q2 = k00, k01, k02
        elif a == 4:
            q0, q1, q2 = k10, k11, k12
        else:
            q0, q1, q2 = k20, k21, k22
        target[a, 0] -= d1 * q2 - d2 * q1
        target[a, 1] -= d2 * q0 - d0 * q2
        target[a, 2] -= d0 * q1 - d1 * q0
        target[a, 3] -= q0
        target[a, 4] -= q1
        target[a, 5] -= q2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _unfold_numba(d0, d1, d2, z, full):
    """full (3, block) = [d x h, h, k] from the stored z = [h, k]."""
    for k in range(3):
        h0, h1, h2 = z[k, 0], z[k, 1], z[k, 2]
        full[k, 0] = d1 * h2 - d2 * h1
        full[k, 1] = d2 * h0 - d0 * h2
        full[k, 2] = d0 * h1 - d1 * h0
        for a in range(z.shape[1]):
            full[k, 3 + a] = z[k, a]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def reduce_rows_numba(start, stop, step, layout, tile_index, values, system, damping, buffers):
    """Block rows `start:stop:step` of the reduced camera system into `buffers.reduced`.

    S_ij = [i = j] (U_i + damping diag) - sum over common points Z_i^T Z_j for free views j <= i;
    rhs_i = -g_i + sum Z_i^T y; border_i = cross_i - sum Z_shared^T Z_i.
    Pairs without a tile are left out (block-diagonal preconditioners ask for few tiles).
    """
    view_start, view_obs, free_index, point = layout.view_start, layout.view_obs, layout.free_index, layout.point_of_obs
    point_start, free_point, pivot, points = layout.point_start, layout.free_point, layout.pivot, values.points
    coupling_start, coupling_camera = layout.couplings.start, layout.couplings.camera
    num_refined, shared_row = layout.num_refined, layout.shared_row
    U, g, cross, y, Z, Z_shared = system.U, system.g, system.cross, buffers.y, buffers.Z, buffers.Z_shared
    tiles, border, rhs = buffers.reduced.tiles, buffers.reduced.border, buffers.reduced.rhs
    per_tile = tiles.shape[1]
    block = Z.shape[2] + 3
    z = np.empty((3, block))
    w = np.empty((3, block))
    tile_of_view = np.empty(stop, dtype=np.int64)
    for i in range(stop):
        tile_of_view[i] = i // per_tile
    for i in range(start, stop, step):
        tile_row = tile_of_view[i]
        local_row = i - tile_row * per_tile
        for J in range(tile_row + 1):
            tile = tile_index[tile_row, J]
            for j in range(per_tile if tile >= 0 else 0):
                for a in range(block):
                    for b in range(block):
                        tiles[tile, local_row, j, a, b] = 0.0
        diagonal = tiles[tile_index[tile_row, tile_row], local_row, local_row]
        for a in range(block):
            rhs[i, a] = -g[i, a]
            for b in range(block):
                diagonal[a, b] = U[i, a, b]
            diagonal[a, a] += damping * U[i, a, a]
            for b in range(border.shape[0]):
                border[b, i, a] = cross[b, i, a]
        for m in range(view_start[i], view_start[i + 1]):
            o = view_obs[m]
            p = point[o]
            if not free_point[p]:
                continue
            d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
            _unfold_numba(d0, d1, d2, Z[o], z)
            for a in range(block):
                rhs[i, a] += z[0, a] * y[p, 0] + z[1, a] * y[p, 1] + z[2, a] * y[p, 2]
            for o2 in range(point_start[p], point_start[p + 1]):
                j = free_index[o2]
                if j < 0:
                    continue
                if j > i:
                    break
                J = tile_of_view[j]
                tile = tile_index[tile_row, J]
                if tile < 0:
                    continue
                target = tiles[tile, local_row, j - J * per_tile]
                if block == 6:
                    _subtract_pose_product_numba(d0, d1, d2, Z[o], Z[o2], target)
                else:
                    _unfold_numba(d0, d1, d2, Z[o2], w)
                    for a in range(block):
                        z0, z1, z2 = z[0, a], z[1, a], z[2, a]
                        for b in range(block):
                            target[a, b] -= z0 * w[0, b] + z1 * w[1, b] + z2 * w[2, b]
            for e in range(coupling_start[p], coupling_start[p + 1]):
                c = coupling_camera[e]
                for k in range(num_refined[c]):
                    e0, e1, e2 = Z_shared[e, 0, k], Z_shared[e, 1, k], Z_shared[e, 2, k]
                    for a in range(block):
                        border[shared_row[c] + k, i, a] -= e0 * z[0, a] + e1 * z[1, a] + e2 * z[2, a]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def reduce_corner_numba(layout, buffers):
    """Subtract the points from `corner` (lower triangle) and `rhs_shared` of the reduced system."""
    couplings, num_refined, shared_row = layout.couplings, layout.num_refined, layout.shared_row
    Z_shared, y, corner, rhs_shared = buffers.Z_shared, buffers.y, buffers.reduced.corner, buffers.reduced.rhs_shared
    for c in range(len(shared_row)):
        row = shared_row[c]
        for m in range(couplings.camera_start[c], couplings.camera_start[c + 1]):
            e = couplings.of_camera[m]
            p = couplings.point[e]
            for a in range(num_refined[c]):
                z0, z1, z2 = Z_shared[e, 0, a], Z_shared[e, 1, a], Z_shared[e, 2, a]
                rhs_shared[row + a] += z0 * y[p, 0] + z1 * y[p, 1] + z2 * y[p, 2]
                for e2 in range(couplings.start[p], couplings.start[p + 1]):
                    column = shared_row[couplings.camera[e2]]
                    if column > row:
                        continue
                    for b in range(num_refined[couplings.camera[e2]]):
                        corner[row + a, column + b] -= (
                            z0 * Z_shared[e2, 0, b] + z1 * Z_shared[e2, 1, b] + z2 * Z_shared[e2, 2, b]
                        )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def views_of_point_numba(start, stop, d0, d1, d2, free_index, Z, x):
    """Sum of Z_i x_i over the views i of the observations `start` to `stop` of a point; d = point - pivot."""
    u0, u1, u2 = 0.0, 0.0, 0.0
    for o in range(start, stop):
        i = free_index[o]
        if i < 0:
            continue
        w0, w1, w2 = x[i, 0], x[i, 1], x[i, 2]
        m0 = x[i, 3] + w1 * d2 - w2 * d1  # (d x h) omega + h v = h (v + omega x d)
        m1 = x[i, 4] + w2 * d0 - w0 * d2
        m2 = x[i, 5] + w0 * d1 - w1 * d0
        u0 += Z[o, 0, 0] * m0 + Z[o, 0, 1] * m1 + Z[o, 0, 2] * m2
        u1 += Z[o, 1, 0] * m0 + Z[o, 1, 1] * m1 + Z[o, 1, 2] * m2
        u2 += Z[o, 2, 0] * m0 + Z[o, 2, 1] * m1 + Z[o, 2, 2] * m2
        for a in range(3, Z.shape[2]):
            u0 += Z[o, 0, a] * x[i, 3 + a]
            u1 += Z[o, 1, a] * x[i, 3 + a]
            u2 += Z[o, 2, a] * x[i, 3 + a]
    return u0, u1, u2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def move_points_numba(start, stop, layout, values, at, damping, step, buffers, moved):
    """Points `start` to `stop` that belong to a step of the views, into `moved`: -L^-T (y + sum Z dx).

    `buffers.decrease` is each point's part of the decrease of the cost that the linear model promises.
    """
    free_index, point_start, pivot, points = layout.free_index, layout.point_start, layout.pivot, values.points
    couplings, num_refined, shared_row = layout.couplings, layout.num_refined, layout.shared_row
    V, g_point, dx, dx_shared, points_new = at.V, at.g_point, step.dx, step.dx_shared, moved.points
    L_inv, y, Z, Z_shared, decrease = buffers.L_inv, buffers.y, buffers.Z, buffers.Z_shared, buffers.decrease
    for p in range(start, stop):
        u0, u1, u2 = y[p, 0], y[p, 1], y[p, 2]
        d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
        v0, v1, v2 = views_of_point_numba(point_start[p], point_start[p + 1], d0, d1, d2, free_index, Z, dx)
        u0 += v0
        u1 += v1
        u2 += v2
        for e in range(couplings.start[p], couplings.start[p + 1]):
            c = couplings.camera[e]
            for a in range(num_refined[c]):
                step = dx_shared[shared_row[c] + a]
                u0 += Z_shared[e, 0, a] * step
                u1 += Z_shared[e, 1, a] * step
                u2 += Z_shared[e, 2, a] * step
        s0 = -(L_inv[p, 0] * u0 + L_inv[p, 1] * u1 + L_inv[p, 3] * u2)
        s1 = -(L_inv[p, 2] * u1 + L_inv[p, 4] * u2)
        s2 = -(L_inv[p, 5] * u2)
        decrease[p] = 0.5 * (
            damping * (V[p, 0] * s0 * s0 + V[p, 2] * s1 * s1 + V[p, 5] * s2 * s2)
            - (g_point[p, 0] * s0 + g_point[p, 1] * s1 + g_point[p, 2] * s2)
        )
        points_new[p, 0] = points[p, 0] + s0
        points_new[p, 1] = points[p, 1] + s1
        points_new[p, 2] = points[p, 2] + s2


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def move_views_numba(layout, values, step, moved):
    """Turn every free view about the pivot by exp(omega) and shift it by R v, with dx = (omega, v, ...)."""
    pivot, dx, R, t, R_new, t_new = layout.pivot, step.dx, values.R, values.t, moved.R, moved.t
    for i in range(layout.num_free_views):
        v = layout.view_order[i]
        w0, w1, w2 = dx[i, 0], dx[i, 1], dx[i, 2]
        angle2 = w0 * w0 + w1 * w1 + w2 * w2
        if angle2 < 1e-8:
            a = 1.0 - angle2 / 6.0
            b = 0.5 - angle2 / 24.0
        else:
            angle = np.sqrt(angle2)
            half = np.sin(0.5 * angle) / angle
            a = np.sin(angle) / angle
            b = 2.0 * half * half
        e00, e11, e22 = 1.0 - b * (w1 * w1 + w2 * w2), 1.0 - b * (w0 * w0 + w2 * w2), 1.0 - b * (w0 * w0 + w1 * w1)
        e01, e02, e12 = b * w0 * w1 - a * w2, b * w0 * w2 + a * w1, b * w1 * w2 - a * w0
        e10, e20, e21 = b * w0 * w1 + a * w2, b * w0 * w2 - a * w1, b * w1 * w2 + a * w0
        s0, s1, s2 = pivot[0] + dx[i, 3], pivot[1] + dx[i, 4], pivot[2] + dx[i, 5]
        for k in range(3):
            r0, r1, r2 = R[v, k, 0], R[v, k, 1], R[v, k, 2]
            n0 = r0 * e00 + r1 * e10 + r2 * e20
            n1 = r0 * e01 + r1 * e11 + r2 * e21
            n2 = r0 * e02 + r1 * e12 + r2 * e22
            R_new[v, k, 0], R_new[v, k, 1], R_new[v, k, 2] = n0, n1, n2
            t_new[v, k] = t[v, k] + r0 * s0 + r1 * s1 + r2 * s2 - (n0 * pivot[0] + n1 * pivot[1] + n2 * pivot[2])
