"""Focal length from fundamental matrices: all pairs vote over a grid of focal lengths.

One pair determines a shared focal length badly or, when the optical axes meet, not at all; many pairs together do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

SMALLEST_RATIO, LARGEST_RATIO, GRID = 0.2, 8.0, 160
TRUNCATION = 0.2
"""A pair that is further than this from being essential says nothing more: it may be wrong altogether."""


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
    grid = np.geomspace(SMALLEST_RATIO, LARGEST_RATIO, GRID)
    cost = np.array([focal_cost(fundamentals, weights, f) for f in grid])
    best = int(np.argmin(cost))
    ratio = float(grid[best])
    if 0 < best < GRID - 1:
        left, middle, right = cost[best - 1 : best + 2]
        curvature = left - 2.0 * middle + right
        if curvature > 0:
            ratio *= float((grid[1] / grid[0]) ** (0.5 * (left - right) / curvature))
    return FocalVote(ratio, float(1.0 - cost[best] / max(float(np.median(cost)), 1e-300)))


def focal_cost(fundamentals: Float[np.ndarray, "k 3 3"], weights: Float[np.ndarray, "k"], focal: float) -> float:
    """Weighted mean of the pairs' truncated distance from being essential."""
    scale = np.array([focal, focal, 1.0])
    s = np.linalg.svd(fundamentals * scale[:, None] * scale, compute_uv=False)
    distance = np.minimum(1.0 - s[:, 1] / np.maximum(s[:, 0], 1e-300), TRUNCATION)
    return float(np.sum(weights * distance) / np.sum(weights))
