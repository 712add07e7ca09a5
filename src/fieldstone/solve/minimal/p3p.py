"""Camera pose from three points (P3P)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.solve.algebra.polynomial_roots import real_roots_of_cubic, real_roots_of_quadratic

MAX_SOLUTIONS = 4
NEWTON_STEPS = 5


def p3p(bearings: Float[np.ndarray, "3 3"], points_in_world: Float[np.ndarray, "3 3"]) -> list[Rigid3]:
    """All poses `cam_from_world` (at most four) that put three points on three bearings, in front of the camera.

    The distances d along the bearings solve three quadratic equations, one for each pair of points,
    d_i^2 + d_j^2 - 2 d_i d_j cos_ij = |X_i - X_j|^2. Two combinations of them are homogeneous conics; a combination
    of these two, found as root of a cubic, falls apart into two lines, and each line meets a conic in two points.

    Collinear points leave the pose undetermined and give no solution or an arbitrary one. On the danger cylinder
    (the camera centre on the circular cylinder through the points) two solutions fall together and lose half of
    their digits.

    Args:
        bearings: Directions in the camera frame, any scale.

    Source:
        `ding2023` for the choice of the cubic's root and the splitting of the conic; `persson2018` for the
        conics and the Newton steps on the distances.
    """
    models = np.empty((MAX_SOLUTIONS, 12))
    unit = bearings / np.linalg.norm(bearings, axis=1, keepdims=True)
    count = p3p_numba(np.ascontiguousarray(unit, np.float64), np.ascontiguousarray(points_in_world, np.float64), models)
    return [Rigid3(models[k, :9].reshape(3, 3).copy(), models[k, 9:].copy()) for k in range(count)]


@njit(cache=True)
@no_type_check
def p3p_numba(y, X, models):  # (3, 3) unit bearings, (3, 3) points -> count; fills models (4, 12) with R, t
    """`p3p` into preallocated rows (R row by row, then t)."""
    a12 = (X[0, 0] - X[1, 0]) ** 2 + (X[0, 1] - X[1, 1]) ** 2 + (X[0, 2] - X[1, 2]) ** 2
    a13 = (X[0, 0] - X[2, 0]) ** 2 + (X[0, 1] - X[2, 1]) ** 2 + (X[0, 2] - X[2, 2]) ** 2
    a23 = (X[1, 0] - X[2, 0]) ** 2 + (X[1, 1] - X[2, 1]) ** 2 + (X[1, 2] - X[2, 2]) ** 2
    c12 = y[0, 0] * y[1, 0] + y[0, 1] * y[1, 1] + y[0, 2] * y[1, 2]
    c13 = y[0, 0] * y[2, 0] + y[0, 1] * y[2, 1] + y[0, 2] * y[2, 2]
    c23 = y[1, 0] * y[2, 0] + y[1, 1] * y[2, 1] + y[1, 2] * y[2, 2]
    total = a12 + a13 + a23
    if not total > 0.0 or min(a12, a13, a23) <= 1e-24 * total:
        return 0
    a12, a13, a23 = a12 / total, a13 / total, a23 / total

    # Conics D1 and D2 (upper triangles 11, 12, 13, 22, 23, 33) without constant terms: d^T D d = 0.
    D1 = (a23, -a23 * c12, 0.0, a23 - a12, a12 * c23, -a12)
    D2 = (a23, 0.0, -a23 * c13, -a13, a13 * c23, a23 - a13)
    found, gamma, D0, adjugate = _degenerate_conic(D1, D2)
    if not found:
        return 0
    # On the lines d^T D1 d = -gamma d^T D2 d: intersect with the conic that does not vanish with gamma.
    D = D1 if abs(gamma) > 1.0 else D2
    l1, l2, l3, m1, m2, m3 = _lines_of_conic(D0, adjugate)
    scale = np.sqrt(total)
    count = 0
    for k in range(2):
        line = (l1, l2, l3) if k == 0 else (m1, m2, m3)
        num, u1, u2, u3, v1, v2, v3 = _line_meets_conic(line, D)
        for j in range(num):
            d = (u1, u2, u3) if j == 0 else (v1, v2, v3)
            ok, d1, d2, d3 = _refine_distances(d, a12, a13, a23, c12, c13, c23)
            if ok and _pose_from_distances(d1 * scale, d2 * scale, d3 * scale, y, X, models[count]):
                count += 1
    return count


@njit(cache=True)
@no_type_check
def _degenerate_conic(D1, D2):
    """gamma and D0 = D1 + gamma D2 with det(D0) = 0 that is a pair of real lines, and the adjugate of D0.

    The adjugate of a degenerate conic is -p p^T for two real lines that meet in p, and +p p^T for complex ones:
    of three real roots, the one with the most negative trace is the best conditioned pair of real lines.
    """
    A1, A2 = _adjugate(D1), _adjugate(D2)
    k3 = D2[0] * A2[0] + D2[1] * A2[1] + D2[2] * A2[2]
    k0 = D1[0] * A1[0] + D1[1] * A1[1] + D1[2] * A1[2]
    k2 = _inner(D1, A2)
    k1 = _inner(D2, A1)
    count, g0, g1, g2 = real_roots_of_cubic(k0, k1, k2, k3)
    best, best_gamma = 0.0, 0.0
    for k in range(count):
        gamma = g0 if k == 0 else (g1 if k == 1 else g2)
        A = _adjugate(_add_scaled(D1, gamma, D2))
        trace = (A[0] + A[3] + A[5]) / (1.0 + gamma * gamma)
        if trace < best:
            best, best_gamma = trace, gamma
    D0 = _add_scaled(D1, best_gamma, D2)
    return best < 0.0, best_gamma, D0, _adjugate(D0)


@njit(cache=True)
@no_type_check
def _add_scaled(A, s, B):
    """A + s B for upper triangles."""
    return A[0] + s * B[0], A[1] + s * B[1], A[2] + s * B[2], A[3] + s * B[3], A[4] + s * B[4], A[5] + s * B[5]


@njit(cache=True)
@no_type_check
def _inner(A, B):
    """trace(A B) of two symmetric matrices given as upper triangles."""
    return A[0] * B[0] + A[3] * B[3] + A[5] * B[5] + 2.0 * (A[1] * B[1] + A[2] * B[2] + A[4] * B[4])


@njit(cache=True)
@no_type_check
def _adjugate(D):
    """Adjugate of a symmetric 3x3 matrix, both as upper triangles 11, 12, 13, 22, 23, 33."""
    a, b, c, d, e, f = D
    return d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b


@njit(cache=True)
@no_type_check
def _lines_of_conic(D0, A):
    """The two lines l, m of a degenerate conic D0 = (l m^T + m l^T) / 2: D0 + [p]_x = l m^T, p p^T = -A."""
    a, b, c, d, e, f = D0
    if A[0] <= A[3] and A[0] <= A[5]:
        s = 1.0 / np.sqrt(max(-A[0], 1e-300))
        p1, p2, p3 = A[0] * s, A[1] * s, A[2] * s
    elif A[3] <= A[5]:
        s = 1.0 / np.sqrt(max(-A[3], 1e-300))
        p1, p2, p3 = A[1] * s, A[3] * s, A[4] * s
    else:
        s = 1.0 / np.sqrt(max(-A[5], 1e-300))
        p1, p2, p3 = A[2] * s, A[4] * s, A[5] * s
    n12, n13, n21, n23, n31, n32 = b - p3, c + p2, b + p3, e - p1, c - p2, e + p1
    # Row and column through the largest entry of the rank-1 matrix.
    r1 = max(abs(a), abs(n12), abs(n13))
    r2 = max(abs(n21), abs(d), abs(n23))
    r3 = max(abs(n31), abs(n32), abs(f))
    if r1 >= r2 and r1 >= r3:
        m1, m2, m3 = a, n12, n13
    elif r2 >= r3:
        m1, m2, m3 = n21, d, n23
    else:
        m1, m2, m3 = n31, n32, f
    if abs(m1) >= abs(m2) and abs(m1) >= abs(m3):
        return a, n21, n31, m1, m2, m3
    if abs(m2) >= abs(m3):
        return n12, d, n32, m1, m2, m3
    return n13, n23, f, m1, m2, m3


@njit(cache=True)
@no_type_check
def _line_meets_conic(line, D):
    """Number of real points (0 or 2), and the points, where a line meets a conic; homogeneous, any scale."""
    l1, l2, l3 = line
    # Two points that span the line, through the largest coefficient so that no digit is lost.
    if abs(l1) >= abs(l2) and abs(l1) >= abs(l3):
        p, q = (-l2, l1, 0.0), (-l3, 0.0, l1)
    elif abs(l2) >= abs(l3):
        p, q = (l2, -l1, 0.0), (0.0, -l3, l2)
    else:
        p, q = (l3, 0.0, -l1), (0.0, l3, -l2)
    pp, pq, qq = _bilinear(p, D, p), _bilinear(p, D, q), _bilinear(q, D, q)
    if abs(pp) >= abs(qq):
        num, s, t = real_roots_of_quadratic(qq, 2.0 * pq, pp)
        u = (s * p[0] + q[0], s * p[1] + q[1], s * p[2] + q[2])
        v = (t * p[0] + q[0], t * p[1] + q[1], t * p[2] + q[2])
    else:
        num, s, t = real_roots_of_quadratic(pp, 2.0 * pq, qq)
        u = (p[0] + s * q[0], p[1] + s * q[1], p[2] + s * q[2])
        v = (p[0] + t * q[0], p[1] + t * q[1], p[2] + t * q[2])
    return num, u[0], u[1], u[2], v[0], v[1], v[2]


@njit(cache=True)
@no_type_check
def _bilinear(p, D, q):
    """p^T D q, D as upper triangle."""
    a, b, c, d, e, f = D
    return (
        p[0] * (a * q[0] + b * q[1] + c * q[2])
        + p[1] * (b * q[0] + d * q[1] + e * q[2])
        + p[2] * (c * q[0] + e * q[1] + f * q[2])
    )


@njit(cache=True)
@no_type_check
def _refine_distances(d, a12, a13, a23, c12, c13, c23):
    """Scale of the distances from the sum of the three equations (whose right sides sum to 1), then Newton steps."""
    d1, d2, d3 = d
    if d1 < 0.0:
        d1, d2, d3 = -d1, -d2, -d3
    norm2 = 2.0 * (d1 * d1 + d2 * d2 + d3 * d3 - d1 * d2 * c12 - d1 * d3 * c13 - d2 * d3 * c23)
    if not (d1 > 0.0 and d2 > 0.0 and d3 > 0.0 and norm2 > 0.0):
        return False, 0.0, 0.0, 0.0
    s = 1.0 / np.sqrt(norm2)
    d1, d2, d3 = d1 * s, d2 * s, d3 * s
    for _ in range(NEWTON_STEPS):
        r12 = d1 * d1 + d2 * d2 - 2.0 * d1 * d2 * c12 - a12
        r13 = d1 * d1 + d3 * d3 - 2.0 * d1 * d3 * c13 - a13
        r23 = d2 * d2 + d3 * d3 - 2.0 * d2 * d3 * c23 - a23
        if abs(r12) + abs(r13) + abs(r23) < 1e-15:
            break
        # Half of the Jacobian: [[p, q, 0], [s, 0, t], [0, u, v]].
        p, q = d1 - d2 * c12, d2 - d1 * c12
        s, t = d1 - d3 * c13, d3 - d1 * c13
        u, v = d2 - d3 * c23, d3 - d2 * c23
        det = -p * t * u - q * s * v
        if det == 0.0:
            break
        h = 0.5 / det
        d1 -= h * (-t * u * r12 - q * v * r13 + q * t * r23)
        d2 -= h * (-s * v * r12 + p * v * r13 - p * t * r23)
        d3 -= h * (s * u * r12 - p * u * r13 - q * s * r23)
    return d1 > 0.0 and d2 > 0.0 and d3 > 0.0, d1, d2, d3


@njit(cache=True)
@no_type_check
def _pose_from_distances(d1, d2, d3, y, X, model):
    """R, t that carry the triangle X to the triangle d y; False where the points are collinear."""
    a1, a2, a3 = d1 * y[0, 0] - d2 * y[1, 0], d1 * y[0, 1] - d2 * y[1, 1], d1 * y[0, 2] - d2 * y[1, 2]
    b1, b2, b3 = d1 * y[0, 0] - d3 * y[2, 0], d1 * y[0, 1] - d3 * y[2, 1], d1 * y[0, 2] - d3 * y[2, 2]
    c1, c2, c3 = a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1
    A1, A2, A3 = X[0, 0] - X[1, 0], X[0, 1] - X[1, 1], X[0, 2] - X[1, 2]
    B1, B2, B3 = X[0, 0] - X[2, 0], X[0, 1] - X[2, 1], X[0, 2] - X[2, 2]
    C1, C2, C3 = A2 * B3 - A3 * B2, A3 * B1 - A1 * B3, A1 * B2 - A2 * B1
    det = C1 * C1 + C2 * C2 + C3 * C3
    if det <= 1e-24 * (A1 * A1 + A2 * A2 + A3 * A3) * (B1 * B1 + B2 * B2 + B3 * B3):
        return False
    # Rows of [A B C]^-1 are B x C, C x A and A x B over the determinant C . C.
    h = 1.0 / det
    U1, U2, U3 = (B2 * C3 - B3 * C2) * h, (B3 * C1 - B1 * C3) * h, (B1 * C2 - B2 * C1) * h
    V1, V2, V3 = (C2 * A3 - C3 * A2) * h, (C3 * A1 - C1 * A3) * h, (C1 * A2 - C2 * A1) * h
    W1, W2, W3 = C1 * h, C2 * h, C3 * h
    model[0], model[1], model[2] = a1 * U1 + b1 * V1 + c1 * W1, a1 * U2 + b1 * V2 + c1 * W2, a1 * U3 + b1 * V3 + c1 * W3
    model[3], model[4], model[5] = a2 * U1 + b2 * V1 + c2 * W1, a2 * U2 + b2 * V2 + c2 * W2, a2 * U3 + b2 * V3 + c2 * W3
    model[6], model[7], model[8] = a3 * U1 + b3 * V1 + c3 * W1, a3 * U2 + b3 * V2 + c3 * W2, a3 * U3 + b3 * V3 + c3 * W3
    for i in range(3):
        model[9 + i] = d1 * y[0, i] - (model[3 * i] * X[0, 0] + model[3 * i + 1] * X[0, 1] + model[3 * i + 2] * X[0, 2])
    return True
