"""What a step minimises besides squared colour errors: terms that depend on where the light of a ray ends.

A new term needs three places: its weight in `plan.LossWeights`, its formula here, and its formula for autograd in
`grid_torch.training.other_terms`. Here it says, for each sample, half the derivative of the loss by its weight
w_i = T_i alpha_i; `composite_backward` turns that into gradients.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from fieldstone.field.grid.simd_numba import at


class Terms(NamedTuple):
    """How much each term counts against the squared colour error of a ray, in one step."""

    sparsity: np.float32
    """Opacity of a ray."""
    emptiness: np.float32
    """Optical depth, by its logarithm, on rays that show nothing but the background."""
    sparse_depth: np.float32
    """Light that does not end at the triangulated point of its ray."""
    free_space: np.float32
    """Light that ends where the points around a ray say that it probably meets nothing."""


class SparseDepths(NamedTuple):
    """Where triangulated points lie on the rays of a table, as rays are marched; rows are the table's rows."""

    distance: np.ndarray
    sigma: np.ndarray
    """Standard deviation of the distance."""
    stretch: np.ndarray
    """How much longer than elsewhere a step is at the point, see `space.stretch`."""


DEPTH_SIGMAS, DEPTH_STEPS = np.float32(2.0), np.float32(1.0)
"""Light may end around a point within so many standard deviations and so many steps."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def ray_terms(samples, rays, num_rays, sparse_depths, step, terms, d_weight):
    """Light that does not end at a triangulated point, twice where it ends before; elsewhere, light that ends early.

    With w_i the weights and m the margin around the point at distance D of a ray, its loss is

        sparse_depth (sum_{t_i < D - m} w_i + 1 - sum_{D - m <= t_i <= D + m} w_i):

    what a photo sees of a point, it sees through empty space, and the point is solid. Rays without a point have

        free_space sum_{t_i < free_distance} w_i:

    a little, so that what the photos clearly show stands there all the same.

    rays: a `RayBatch`. d_weight: (s).

    Source:
        `deng2022` has the idea of points as supervision. Departure: a window in place of a normal distribution, so
        that nothing is said within the uncertainty of the point.
    """
    half, half_free = np.float32(0.5) * terms.sparse_depth, np.float32(0.5) * terms.free_space
    for ray in range(num_rays):
        row = rays.depth_row[ray]
        start, end = rays.first[ray], rays.first[ray + 1]
        if row < 0:
            for i in range(start, end):
                d_weight[i] = half_free if at(samples.distance, i) < rays.free_distance[ray] else np.float32(0)
            continue
        margin = DEPTH_SIGMAS * sparse_depths.sigma[row] + DEPTH_STEPS * step * sparse_depths.stretch[row]
        low, high = sparse_depths.distance[row] - margin, sparse_depths.distance[row] + margin
        for i in range(start, end):
            t = at(samples.distance, i)
            d_weight[i] = half if t < low else (-half if t <= high else np.float32(0))
