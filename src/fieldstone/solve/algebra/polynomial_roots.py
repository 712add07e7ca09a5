"""Real roots of small polynomials, compiled for the minimal solvers.

Coefficients are ordered by rising power: c[0] + c[1] x + c[2] x^2 + ...
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

MAX_ROOT_STEPS = 60
NEGLIGIBLE = 1e-14


@njit(cache=True)
@no_type_check
def real_roots_of_quadratic(c0, c1, c2):  # -> (number of roots, root, root)
    """Real roots of c0 + c1 x + c2 x^2 without cancellation; c2 may be 0.

    A pair of complex roots whose imaginary part is rounding noise counts as one double root.

    Source:
        `press2007`, section 5.6.
    """
    if c2 == 0.0:
        return (0, 0.0, 0.0) if c1 == 0.0 else (1, -c0 / c1, 0.0)
    discriminant = c1 * c1 - 4.0 * c0 * c2
    if discriminant < 0.0:
        if discriminant < -NEGLIGIBLE * c1 * c1:
            return 0, 0.0, 0.0
        discriminant = 0.0
    q = -0.5 * (c1 + np.copysign(np.sqrt(discriminant), c1))
    if q == 0.0:
        return 2, 0.0, 0.0
    return 2, q / c2, c0 / q


@njit(cache=True)
@no_type_check
def real_roots_of_cubic(c0, c1, c2, c3):  # -> (number of roots, root, root, root)
    """Real roots of c0 + c1 x + c2 x^2 + c3 x^3; c3 may be 0.

    The trigonometric or hyperbolic closed form, then two Newton steps.

    Source:
        `press2007`, section 5.6.
    """
    largest = max(abs(c0), abs(c1), abs(c2))
    if abs(c3) <= 1e-300 or abs(c3) < 1e-15 * largest:
        count, x0, x1 = real_roots_of_quadratic(c0, c1, c2)
        return count, x0, x1, 0.0
    a, b, c = c2 / c3, c1 / c3, c0 / c3
    Q = (a * a - 3.0 * b) / 9.0
    R = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    if R * R < Q * Q * Q:
        theta = np.arccos(R / np.sqrt(Q * Q * Q))
        scale = -2.0 * np.sqrt(Q)
        x0 = scale * np.cos(theta / 3.0) - a / 3.0
        x1 = scale * np.cos((theta + 2.0 * np.pi) / 3.0) - a / 3.0
        x2 = scale * np.cos((theta - 2.0 * np.pi) / 3.0) - a / 3.0
        return 3, _polish_cubic(a, b, c, x0), _polish_cubic(a, b, c, x1), _polish_cubic(a, b, c, x2)
    A = -np.copysign(np.cbrt(abs(R) + np.sqrt(max(R * R - Q * Q * Q, 0.0))), R)
    B = Q / A if A != 0.0 else 0.0
    return 1, _polish_cubic(a, b, c, A + B - a / 3.0), 0.0, 0.0


@njit(cache=True)
@no_type_check
def _polish_cubic(a, b, c, x):
    """Two Newton steps on x^3 + a x^2 + b x + c, kept only where they lower the residual."""
    value = ((x + a) * x + b) * x + c
    for _ in range(2):
        slope = (3.0 * x + 2.0 * a) * x + b
        if slope == 0.0:
            break
        candidate = x - value / slope
        candidate_value = ((candidate + a) * candidate + b) * candidate + c
        if abs(candidate_value) >= abs(value):
            break
        x, value = candidate, candidate_value
    return x


@njit(cache=True)
@no_type_check
def real_roots_numba(
    c, degree, chain, roots
):  # (>= degree + 1,), scratch (degree + 1, degree + 2) -> count; fills roots
    """All real roots of a polynomial of any degree: isolated by Sturm's theorem, refined by safeguarded Newton steps.

    The line is mapped to s in (-1, 1) by x = s / (1 - |s|), so that roots of any size are found by bisection of s.
    Roots closer than about 1e-9 in s count as one.

    Source:
        Sturm's theorem; `press2007`, section 9.4 for the safeguarded Newton method.
    """
    while degree > 0 and c[degree] == 0.0:
        degree -= 1
    if degree <= 0:
        return 0
    length = _sturm_chain(c, degree, chain)
    # Intervals still to split, as a stack: ends in s and the numbers of sign changes there.
    low, high = np.empty(64), np.empty(64)
    low_changes, high_changes = np.empty(64, np.int64), np.empty(64, np.int64)
    low[0], high[0] = -1.0, 1.0
    low_changes[0] = _sign_changes(chain, length, -1.0)
    high_changes[0] = _sign_changes(chain, length, 1.0)
    top, count = 1, 0
    while top > 0:
        top -= 1
        a, b, na, nb = low[top], high[top], low_changes[top], high_changes[top]
        if na - nb <= 0:
            continue
        if na - nb == 1 or b - a < 1e-9:
            roots[count] = _root_between(chain, degree, a, b)
            count += 1
            continue
        middle = 0.5 * (a + b)
        nm = _sign_changes(chain, length, middle)
        low[top], high[top], low_changes[top], high_changes[top] = middle, b, nm, nb
        low[top + 1], high[top + 1], low_changes[top + 1], high_changes[top + 1] = a, middle, na, nm
        top += 2
    return count


@njit(cache=True)
@no_type_check
def _sturm_chain(c, degree, chain):
    """p, p', and negated remainders; row k holds degree - k in its last place. Returns the number of rows."""
    last = chain.shape[1] - 1
    scale = 0.0
    for i in range(degree + 1):
        scale = max(scale, abs(c[i]))
    for i in range(degree + 1):
        chain[0, i] = c[i] / scale
    for i in range(degree):
        chain[1, i] = (i + 1) * chain[0, i + 1]
    chain[0, last], chain[1, last] = degree, degree - 1
    row = 1
    while chain[row, last] > 0:
        n, m = int(chain[row - 1, last]), int(chain[row, last])
        divisor = chain[row]
        rest = chain[row + 1]
        for i in range(n + 1):
            rest[i] = chain[row - 1, i]
        for k in range(n - m, -1, -1):
            q = rest[m + k] / divisor[m]
            for i in range(m + 1):
                rest[i + k] -= q * divisor[i]
        largest = 0.0
        for i in range(m):
            largest = max(largest, abs(rest[i]))
        if not largest > 1e-14:
            break
        new_degree = m - 1
        while new_degree > 0 and abs(rest[new_degree]) < 1e-14 * largest:
            new_degree -= 1
        for i in range(new_degree + 1):
            rest[i] = -rest[i] / largest
        row += 1
        chain[row, last] = new_degree
    return row + 1


@njit(cache=True)
@no_type_check
def _sign_changes(chain, length, s):
    """Sign changes of the chain at x = s / (1 - |s|), evaluated in homogeneous form so that |s| = 1 is infinity."""
    last = chain.shape[1] - 1
    w = 1.0 - abs(s)
    changes = 0
    previous = 0.0
    for row in range(length):
        value = _homogeneous_value(chain[row], int(chain[row, last]), s, w)
        if value != 0.0:
            if value * previous < 0.0:
                changes += 1
            previous = np.copysign(1.0, value)
    return changes


@njit(cache=True)
@no_type_check
def _homogeneous_value(c, degree, s, w):
    """sum_i c_i s^i w^(degree - i)."""
    value = c[degree]
    power = 1.0
    for i in range(degree - 1, -1, -1):
        power *= w
        value = value * s + c[i] * power
    return value


@njit(cache=True)
@no_type_check
def _root_between(chain, degree, a, b):
    """Root of row 0 in (a, b) of s, returned as x: bisection until the Newton step stays inside, then Newton."""
    c = chain[0]
    at_a = _homogeneous_value(c, degree, a, 1.0 - abs(a))
    for _ in range(4):
        middle = 0.5 * (a + b)
        at_middle = _homogeneous_value(c, degree, middle, 1.0 - abs(middle))
        if at_middle * at_a > 0.0:
            a, at_a = middle, at_middle
        else:
            b = middle
    s = 0.5 * (a + b)
    for _ in range(MAX_ROOT_STEPS):
        w = 1.0 - abs(s)
        # p and dp/dx at x = s / w, scaled by powers of w; dx/ds = 1 / w^2.
        value, slope, power = c[degree], 0.0, 1.0
        for i in range(degree - 1, -1, -1):
            power *= w
            slope = slope * s + value
            value = value * s + c[i] * power
        # slope here is p'(x) w^(degree - 1), value is p(x) w^degree.
        if value * at_a > 0.0:
            a = s
        else:
            b = s
        new = s - value * w / slope if slope != 0.0 else 0.5 * (a + b)
        if not a < new < b:
            new = 0.5 * (a + b)
        change = abs(new - s)
        s = new
        if change < 1e-15:
            break
    return s / max(1.0 - abs(s), 1e-300)
