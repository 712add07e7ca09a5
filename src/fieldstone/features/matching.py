"""Mutual nearest neighbours with a ratio test; of faint features, those that turn and grow alike."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.features.nearest import TwoNearest
from fieldstone.features.nearest_numba import two_nearest_numba
from fieldstone.scene.features import Features

FAINT_MAX_RATIO = 0.95
"""Ratio test of faint features: noise blurs what sets them apart, and few are there to be taken for each other."""
MAX_TURN = float(np.deg2rad(25.0))
"""Matches whose rotations in the photo differ by less have one motion."""
MAX_GROWTH = float(np.sqrt(2.0))
"""And whose factors of scale differ by less than this factor."""


def match_mutual(a: Features, b: Features, max_ratio: float) -> Int[np.ndarray, "m 2"]:
    """Pairs of features that are each other's nearest, and much nearer than the second nearest, both ways.

    A pair is kept if distance < max_ratio * (distance to the second nearest) seen from a as well as from b, so that
    exchanging the photos exchanges the columns. Of equally near features neither is much nearer, so ties never
    match while max_ratio < 1; with max_ratio = 1 the lower index wins.

    Returns:
        Rows (index in a, index in b), by index in a.

    Raises:
        ValueError: A ratio outside (0, 1].

    Source:
        `lowe2004`, section 7.1. Departure: the ratio is tested both ways.
    """
    if not 0 < max_ratio <= 1:
        raise ValueError(f"max_ratio must lie in (0, 1], got {max_ratio}")
    if not len(a) or not len(b):
        return np.empty((0, 2), dtype=np.int64)
    from_a, from_b = two_nearest_numba(a.descriptors, b.descriptors)
    return mutual_and_distinct(from_a, from_b, max_ratio)


def mutual_and_distinct(from_a: TwoNearest, from_b: TwoNearest, max_ratio: float) -> Int[np.ndarray, "m 2"]:
    """Pairs that chose each other and pass the ratio test both ways, by index in a; index -1 chose nobody."""
    i = np.flatnonzero(from_a.index >= 0)
    j = from_a.index[i]
    good = (from_b.index[j] == i) & from_a.distinct(max_ratio)[i] & from_b.distinct(max_ratio)[j]
    return np.stack([i[good], j[good]], axis=1).astype(np.int64)


def match_faint(a: Features, b: Features, max_ratio: float = FAINT_MAX_RATIO) -> Int[np.ndarray, "m 2"]:
    """`match_mutual` with a loose ratio test, and of its matches those of the most common rotation and scale.

    Between photos of one place features turn and grow alike, while false matches do so as they like: the motion takes
    nine of ten of them out, which the ratio test cannot where descriptors are noisy.

    Returns:
        Rows (index in a, index in b), by index in a.
    """
    rows = match_mutual(a, b, max_ratio)
    return rows[of_one_motion(b.angle[rows[:, 1]] - a.angle[rows[:, 0]], b.scale[rows[:, 1]] / a.scale[rows[:, 0]])]


def of_one_motion(turn: Float[np.ndarray, "m"], growth: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Which matches turn and grow like the one that most others are like.

    Args:
        turn: Angle of the second feature less that of the first, in radians.
        growth: Scale of the second feature over that of the first.

    Source:
        The weak geometric consistency of `jegou2008`, section 5. Departure: no histogram, whose borders would split
        a motion.
    """
    if not len(turn):
        return np.zeros(0, dtype=bool)
    difference = np.abs((turn[:, None] - turn + np.pi) % (2.0 * np.pi) - np.pi)
    log_growth = np.log(growth)
    alike = (difference < MAX_TURN) & (np.abs(log_growth[:, None] - log_growth) < np.log(MAX_GROWTH))
    return alike[np.argmax(alike.sum(axis=1))]
