"""Polynomials of three unknowns x, y, z up to degree three, as flat coefficient arrays, for the five-point solver.

degree 1: x, y, z, 1
degree 2: x2, xy, y2, xz, yz, z2, x, y, z, 1
degree 3: x3, y3, x2y, xy2, x2z, x2, y2z, y2, xyz, xy, then x (z2, z, 1), y (z2, z, 1), 1 (z3, z2, z, 1)
"""

from __future__ import annotations

from typing import no_type_check

from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def add_product_1_1(a, b, sign, out):  # (4,), (4,), (10,)
    """out += sign a b for two polynomials of degree one."""
    a0, a1, a2, a3 = sign * a[0], sign * a[1], sign * a[2], sign * a[3]
    b0, b1, b2, b3 = b[0], b[1], b[2], b[3]
    out[0] += a0 * b0
    out[1] += a0 * b1 + a1 * b0
    out[2] += a1 * b1
    out[3] += a0 * b2 + a2 * b0
    out[4] += a1 * b2 + a2 * b1
    out[5] += a2 * b2
    out[6] += a0 * b3 + a3 * b0
    out[7] += a1 * b3 + a3 * b1
    out[8] += a2 * b3 + a3 * b2
    out[9] += a3 * b3


@njit(cache=True, nogil=True)
@no_type_check
def add_product_2_1(a, b, out):  # (10,), (4,), (20,)
    """out += a b for polynomials of degree two and one."""
    xx, xy, yy, xz, yz, zz, x, y, z, w = a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9]
    b0, b1, b2, b3 = b[0], b[1], b[2], b[3]
    out[0] += xx * b0
    out[1] += yy * b1
    out[2] += xx * b1 + xy * b0
    out[3] += xy * b1 + yy * b0
    out[4] += xx * b2 + xz * b0
    out[5] += xx * b3 + x * b0
    out[6] += yy * b2 + yz * b1
    out[7] += yy * b3 + y * b1
    out[8] += xy * b2 + xz * b1 + yz * b0
    out[9] += xy * b3 + x * b1 + y * b0
    out[10] += xz * b2 + zz * b0
    out[11] += xz * b3 + x * b2 + z * b0
    out[12] += x * b3 + w * b0
    out[13] += yz * b2 + zz * b1
    out[14] += yz * b3 + y * b2 + z * b1
    out[15] += y * b3 + w * b1
    out[16] += zz * b2
    out[17] += zz * b3 + z * b2
    out[18] += z * b3 + w * b2
    out[19] += w * b3
