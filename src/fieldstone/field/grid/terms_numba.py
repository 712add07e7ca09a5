"""What counts besides colour along the rays of a step: known points on them.

Every term says, for each sample, half the derivative of the loss by its weight w_i = T_i alpha_i; `composite_backward`
does the rest.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from fieldstone.field.grid.simd_numba import at


class Terms(NamedTuple):
    """How much each term counts against the squared colour error of a ray."""

    sparsity: np.float32
    """Opacity of a ray."""
    emptiness: np.float32
    """Optical depth, by its logarithm, on rays that show nothing but the background."""
    points: np.float32
    """Light that does not end at the known point of its ray."""
    free: np.float32
    """Light that ends where the points around a ray say that it probably meets nothing."""


class PointRays(NamedTuple):
    """Where known points lie on the rays of a table, in the space that rays are marched in; rows are its rows."""

    distance: np.ndarray
    sigma: np.ndarray
    """Standard deviation of the distance."""
    stretch: np.ndarray
    """How much longer than elsewhere a step is at the point."""


POINT_SIGMAS, POINT_STEPS = np.float32(2.0), np.float32(1.0)
"""Light may end around a point within so many standard deviations and so many steps."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def point_terms(samples, num_rays, first, rows, free, points, step, weight, free_weight, d_weight):
    """Light that does not end at a known point, twice where it ends before; on other rays, light that ends early.

    With w_i the weights and m the margin around the point at distance D of a ray, its loss is

        weight (sum_{t_i < D - m} w_i + 1 - sum_{D - m <= t_i <= D + m} w_i):

    what a photo sees of a point, it sees through empty space, and the point is solid. Rays without a point have

        free_weight sum_{t_i < free} w_i:

    a little, so that what the photos clearly show stands there all the same.

    rows: (r) row in points of each ray, negative: none. free: (r). d_weight: (s).

    Source:
        `deng2022` has the idea of points as supervision. Departure: a window in place of a normal distribution, so
        that nothing is said within the uncertainty of the point.
    """
    half, half_free = np.float32(0.5) * weight, np.float32(0.5) * free_weight
    for ray in range(num_rays):
        row = rows[ray]
        start, end = first[ray], first[ray + 1]
        if row < 0:
            for i in range(start, end):
                d_weight[i] = half_free if at(samples.distance, i) < free[ray] else np.float32(0)
            continue
        margin = POINT_SIGMAS * points.sigma[row] + POINT_STEPS * step * points.stretch[row]
        low, high = points.distance[row] - margin, points.distance[row] + margin
        for i in range(start, end):
            t = at(samples.distance, i)
            d_weight[i] = half if t < low else (-half if t <= high else np.float32(0))
