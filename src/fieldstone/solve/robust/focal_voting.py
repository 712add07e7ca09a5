"""Focal length from fundamental matrices, or from the homographies of a turning camera: all pairs vote over a grid.

One pair determines a shared focal length badly or, when the optical axes meet, not at all; many pairs together do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rotation import angle_between, nearest_rotation

SMALLEST_RATIO, LARGEST_RATIO, GRID = 0.2, 8.0, 160
TRUNCATION = 0.2
"""A pair that is further than this from being essential says nothing more: it may be wrong altogether."""
LARGEST_DEVIATION = 0.02
"""Homographies that are further than this from rotations, on average, are those of a plane."""

SMALLEST_TURN = float(np.deg2rad(1.0))
"""A camera that turns less, on average, tells nothing: copies of one photo fit any focal length."""


@dataclass(frozen=True)
class FocalVote:
    """ratio: focal length over the unit of the coordinates. contrast: how much better it is than the median of the
    grid, from 0 (the pairs do not care) to 1."""

    ratio: float
    contrast: float


def vote_focal(fundamentals: Float[np.ndarray, "k 3 3"], weights: Float[np.ndarray, "k"]) -> FocalVote:
    """The focal length f for which K^T F K with K = diag(f, f, 1) is most nearly essential, over all pairs.

    An essential matrix has two equal singular values s1 = s2: a pair costs min(1 - s2 / s1, truncation), times its
    weight. The minimum over a logarithmic grid is refined by a parabola through its neighbours.

    Args:
        fundamentals: F of coordinates whose origin is the principal point, in any common unit (the longer side, say).

    Raises:
        ValueError: No pair.

    Source:
        `li2025fastmap`, section 3.2; the constraint `mendonca1999`.
    """
    if not len(fundamentals):
        raise ValueError("a focal length cannot be voted on without pairs")
    return _lowest(lambda focal: focal_cost(fundamentals, weights, focal))[0]


def vote_focal_of_rotations(
    homographies: Float[np.ndarray, "k 3 3"], weights: Float[np.ndarray, "k"]
) -> FocalVote | None:
    """The focal length f for which K^-1 H K is most nearly a rotation over all pairs; None if none comes near,
    or if the camera hardly turns.

    A camera that turns on the spot has no fundamental matrix, and with a wrong focal length its homographies look like
    those of a plane seen from several places.

    Args:
        homographies: H of coordinates as in `vote_focal`.

    Source:
        `hartley2004`, section 19.6.
    """
    if not len(homographies):
        return None
    vote, cost = _lowest(lambda focal: rotation_cost(homographies, weights, focal))
    R = nearest_rotation(_with_focal(homographies, vote.ratio))
    turn = float(np.average(angle_between(R, np.broadcast_to(np.eye(3), R.shape)), weights=weights))
    return vote if cost < LARGEST_DEVIATION and turn > SMALLEST_TURN else None


def _lowest(cost_of: Callable[[float], float]) -> tuple[FocalVote, float]:
    """The vote over the grid, its minimum refined, and the cost there."""
    grid = np.geomspace(SMALLEST_RATIO, LARGEST_RATIO, GRID)
    cost = np.array([cost_of(float(f)) for f in grid])
    best = int(np.argmin(cost))
    ratio = float(grid[best])
    if 0 < best < GRID - 1:
        left, middle, right = cost[best - 1 : best + 2]
        curvature = left - 2.0 * middle + right
        if curvature > 0:
            ratio *= float((grid[1] / grid[0]) ** (0.5 * (left - right) / curvature))
    return FocalVote(ratio, float(1.0 - cost[best] / max(float(np.median(cost)), 1e-300))), float(cost[best])


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


def focal_cost(fundamentals: Float[np.ndarray, "k 3 3"], weights: Float[np.ndarray, "k"], focal: float) -> float:
    """Weighted mean of the pairs' truncated distance from being essential."""
    scale = np.array([focal, focal, 1.0])
    s = np.linalg.svd(fundamentals * scale[:, None] * scale, compute_uv=False)
    distance = np.minimum(1.0 - s[:, 1] / np.maximum(s[:, 0], 1e-300), TRUNCATION)
    return float(np.sum(weights * distance) / np.sum(weights))
