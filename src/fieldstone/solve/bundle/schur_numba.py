"""Compiled Schur complement of bundle adjustment; `schur.py` is the readable reference.

Every kernel works on a range of points or views, writes only what belongs to that range, and adds in a fixed order.
Ranges can therefore run in any number of threads, and the result has the same bits.

Notation, for observation o of point p by the view in slot i (Cholesky: V + damping = L L^T, V the 3x3 block of p):
Z (3, block) = L^-1 B^T [pose Jacobian | own camera Jacobian], with the Jacobians of `linearize_numba`, so that the
reduced system loses Z_i^T Z_j for every point that slots i and j share. The rows of Z are [d x h, h, own] with
h = L^-1 B^T B: only [h, own] is stored, (3, block - 3), and the rotation's part d x h is made where it is needed.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def mark_shared_tiles_numba(point_start, slot, free_point, per_tile, exists):
    """Set exists[I, J], J <= I, where a free point is seen by slots of tile I and of tile J."""
    for p in range(len(free_point)):
        if not free_point[p]:
            continue
        for o in range(point_start[p], point_start[p + 1]):
            for o2 in range(point_start[p], o + 1 if slot[o] >= 0 else 0):
                if slot[o2] >= 0:
                    exists[slot[o] // per_tile, slot[o2] // per_tile] = True


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def eliminate_points_numba(
    start, stop, view, slot, point_start, camera_of_view, num_active, own, entry_start, entry_of_obs, free_point,
    B, J_camera, V, g_point, damping, L_inv, y, Z, Z_border,
):  # fmt: skip
    """L_inv (p, 6 lower), y = L^-1 g (p, 3), Z (o, 3, block - 3) and Z_border (e, 3, a) for V + damping diag(V).

    Held points, and points whose block is singular, get L_inv = 0: they do not move in this step.
    """
    grow = 1.0 + damping
    for p in range(start, stop):
        for e in range(entry_start[p], entry_start[p + 1]):
            for k in range(3):
                for a in range(Z_border.shape[2]):
                    Z_border[e, k, a] = 0.0
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
            e = entry_of_obs[o]
            in_slot = slot[o] >= 0
            if not in_slot and e < 0:
                continue
            num_own = num_active[c] if own[c] else 0
            for k in range(3):
                m0 = a0 if k == 0 else (a1 if k == 1 else a3)
                m1 = 0.0 if k == 0 else (a2 if k == 1 else a4)
                m2 = a5 if k == 2 else 0.0
                q0 = B[o, 0, 0] * m0 + B[o, 0, 1] * m1 + B[o, 0, 2] * m2
                q1 = B[o, 1, 0] * m0 + B[o, 1, 1] * m1 + B[o, 1, 2] * m2
                if in_slot:
                    Z[o, k, 0] = q0 * B[o, 0, 0] + q1 * B[o, 1, 0]
                    Z[o, k, 1] = q0 * B[o, 0, 1] + q1 * B[o, 1, 1]
                    Z[o, k, 2] = q0 * B[o, 0, 2] + q1 * B[o, 1, 2]
                    for a in range(Z.shape[2] - 3):
                        Z[o, k, 3 + a] = q0 * J_camera[o, 0, a] + q1 * J_camera[o, 1, a] if a < num_own else 0.0
                if e >= 0:
                    for a in range(num_active[c]):
                        Z_border[e, k, a] += q0 * J_camera[o, 0, a] + q1 * J_camera[o, 1, a]


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
    """full (3, block) = [d x h, h, own] from the stored z = [h, own]."""
    for k in range(3):
        h0, h1, h2 = z[k, 0], z[k, 1], z[k, 2]
        full[k, 0] = d1 * h2 - d2 * h1
        full[k, 1] = d2 * h0 - d0 * h2
        full[k, 2] = d0 * h1 - d1 * h0
        for a in range(z.shape[1]):
            full[k, 3 + a] = z[k, a]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def reduce_rows_numba(
    start, stop, step, list_start, list_obs, slot, point, point_start, free_point, entry_start, entry_camera,
    num_active, border_of_camera, tile_index, tiles, points, pivot, U, g, cross, damping, y, Z, Z_border, border, rhs,
):  # fmt: skip
    """Block rows `start:stop:step` of the reduced camera system into tiles (tile, row, column, block, block).

    S_ij = [i = j] (U_i + damping diag) - sum over common points Z_i^T Z_j for slots j <= i;
    rhs (s, block) = -g_i + sum Z_i^T y; border (rows, s, block) = cross - sum Z_border^T Z_i.
    Pairs without a tile are left out (block-diagonal preconditioners ask for few tiles).
    """
    per_tile = tiles.shape[1]
    block = Z.shape[2] + 3
    z = np.empty((3, block))
    w = np.empty((3, block))
    tile_of_slot = np.empty(stop, dtype=np.int64)
    for i in range(stop):
        tile_of_slot[i] = i // per_tile
    for i in range(start, stop, step):
        tile_row = tile_of_slot[i]
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
        for m in range(list_start[i], list_start[i + 1]):
            o = list_obs[m]
            p = point[o]
            if not free_point[p]:
                continue
            d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
            _unfold_numba(d0, d1, d2, Z[o], z)
            for a in range(block):
                rhs[i, a] += z[0, a] * y[p, 0] + z[1, a] * y[p, 1] + z[2, a] * y[p, 2]
            for o2 in range(point_start[p], point_start[p + 1]):
                j = slot[o2]
                if j < 0:
                    continue
                if j > i:
                    break
                J = tile_of_slot[j]
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
            for e in range(entry_start[p], entry_start[p + 1]):
                c = entry_camera[e]
                for k in range(num_active[c]):
                    e0, e1, e2 = Z_border[e, 0, k], Z_border[e, 1, k], Z_border[e, 2, k]
                    for a in range(block):
                        border[border_of_camera[c] + k, i, a] -= e0 * z[0, a] + e1 * z[1, a] + e2 * z[2, a]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def reduce_border_numba(
    border_start, border_entries, entry_start, entry_camera, entry_point, num_active, border_of_camera,
    Z_border, y, corner, rhs_border,
):  # fmt: skip
    """Subtract the points from the border's own block `corner` (lower triangle) and right-hand side."""
    for c in range(len(border_start) - 1):
        row = border_of_camera[c]
        for m in range(border_start[c], border_start[c + 1]):
            e = border_entries[m]
            p = entry_point[e]
            for a in range(num_active[c]):
                z0, z1, z2 = Z_border[e, 0, a], Z_border[e, 1, a], Z_border[e, 2, a]
                rhs_border[row + a] += z0 * y[p, 0] + z1 * y[p, 1] + z2 * y[p, 2]
                for e2 in range(entry_start[p], entry_start[p + 1]):
                    column = border_of_camera[entry_camera[e2]]
                    if column > row:
                        continue
                    for b in range(num_active[entry_camera[e2]]):
                        corner[row + a, column + b] -= (
                            z0 * Z_border[e2, 0, b] + z1 * Z_border[e2, 1, b] + z2 * Z_border[e2, 2, b]
                        )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def views_of_point_numba(start, stop, d0, d1, d2, slot, Z, x):
    """Sum of Z_i x_i over the views i of the observations `start` to `stop` of a point; d = point - pivot."""
    u0, u1, u2 = 0.0, 0.0, 0.0
    for o in range(start, stop):
        i = slot[o]
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
def move_points_numba(
    start, stop, slot, point_start, entry_start, entry_camera, num_active, border_of_camera, points, pivot,
    V, g_point, damping, L_inv, y, Z, Z_border, dx, dx_border, points_new, decrease,
):  # fmt: skip
    """Points that belong to the step dx (s, block), dx_border of the cameras: step = -L^-T (y + sum Z dx).

    `decrease` (p,) is each point's share of the decrease of the cost that the linear model promises.
    """
    for p in range(start, stop):
        u0, u1, u2 = y[p, 0], y[p, 1], y[p, 2]
        d0, d1, d2 = points[p, 0] - pivot[0], points[p, 1] - pivot[1], points[p, 2] - pivot[2]
        v0, v1, v2 = views_of_point_numba(point_start[p], point_start[p + 1], d0, d1, d2, slot, Z, dx)
        u0 += v0
        u1 += v1
        u2 += v2
        for e in range(entry_start[p], entry_start[p + 1]):
            c = entry_camera[e]
            for a in range(num_active[c]):
                step = dx_border[border_of_camera[c] + a]
                u0 += Z_border[e, 0, a] * step
                u1 += Z_border[e, 1, a] * step
                u2 += Z_border[e, 2, a] * step
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
def move_views_numba(num_slots, listed_view, pivot, dx, R, t, R_new, t_new):
    """Turn pose i about the pivot by exp(omega) and shift it by R v, with dx[i] = (omega, v, ...)."""
    for i in range(num_slots):
        v = listed_view[i]
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
