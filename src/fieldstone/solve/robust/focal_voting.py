"""Focal length from the homographies of a turning camera: all pairs vote over a grid.

Where a camera moves, its pairs have fundamental matrices: see `solve.averaging.focal_lengths`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rotation import angle_between, nearest_rotation

SMALLEST_RATIO, LARGEST_RATIO, GRID = 0.2, 8.0, 160
TRUNCATION = 0.2
"""A pair that is further than this from being a rotation says nothing more: it may be wrong altogether."""
SMALLEST_CONTRAST = 0.1
"""A vote whose cost is not lower than the median of the grid's by this share says nothing."""
LARGEST_DEVIATION = 0.02
"""Homographies that are further than this from rotations, on average, are those of a plane."""

SMALLEST_TURN = float(np.deg2rad(1.0))
"""A camera that turns less, on average, tells nothing: copies of one photo fit any focal length."""


def vote_focal_of_rotations(homographies: Float[np.ndarray, "k 3 3"], weights: Float[np.ndarray, "k"]) -> float | None:
    """The focal length f for which K^-1 H K is most nearly a rotation over all pairs; None if none comes near or
    all come equally near, or if the camera hardly turns. The minimum over a grid is refined by a parabola.

    A camera that turns on the spot has no fundamental matrix, and with a wrong focal length its homographies look like
    those of a plane seen from several places.

    Args:
        homographies: H of coordinates whose origin is the principal point, in any common unit (the longer side, say).

    Source:
        `hartley2004`, section 19.6.
    """
    if not len(homographies):
        return None
    grid = np.geomspace(SMALLEST_RATIO, LARGEST_RATIO, GRID)
    cost = np.array([rotation_cost(homographies, weights, float(f)) for f in grid])
    best = int(np.argmin(cost))
    ratio = float(grid[best])
    if 0 < best < GRID - 1:
        left, middle, right = cost[best - 1 : best + 2]
        curvature = left - 2.0 * middle + right
        if curvature > 0:
            ratio *= float((grid[1] / grid[0]) ** (0.5 * (left - right) / curvature))
    contrast = 1.0 - cost[best] / max(float(np.median(cost)), 1e-300)
    R = nearest_rotation(_with_focal(homographies, ratio))
    turn = float(np.average(angle_between(R, np.broadcast_to(np.eye(3), R.shape)), weights=weights))
    if cost[best] >= LARGEST_DEVIATION or contrast < SMALLEST_CONTRAST or turn <= SMALLEST_TURN:
        return None
    return ratio


def rotation_cost(homographies: Float[np.ndarray, "k 3 3"], weights: Float[np.ndarray, "k"], focal: float) -> float:
    """Weighted mean of the pairs' truncated distance from being rotations."""
    M = _with_focal(homographies, focal)
    distance = np.minimum(np.linalg.norm(M - nearest_rotation(M), axis=(1, 2)), TRUNCATION)
    return float(np.sum(weights * distance) / np.sum(weights))


def _with_focal(homographies: Float[np.ndarray, "k 3 3"], focal: float) -> Float[np.ndarray, "k 3 3"]:
    """K^-1 H K of determinant 1."""
    scale = np.array([focal, focal, 1.0])
    M = homographies * scale / scale[:, None]
    return M / np.cbrt(np.linalg.det(M))[:, None, None]
