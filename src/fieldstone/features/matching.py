"""Mutual nearest neighbours with a ratio test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from fieldstone.features.nearest import TwoNearest
from fieldstone.features.nearest_numba import two_nearest_numba
from fieldstone.scene.features import Features


@dataclass(frozen=True)
class MutualRatio:
    """Matcher: `MutualRatio(0.8)(a, b)`, see `match_mutual`."""

    max_ratio: float = 0.8

    def __post_init__(self) -> None:
        if not 0 < self.max_ratio <= 1:
            raise ValueError(f"max_ratio must lie in (0, 1], got {self.max_ratio}")

    def __call__(self, a: Features, b: Features) -> Int[np.ndarray, "m 2"]:
        """Rows (index in a, index in b)."""
        return match_mutual(a, b, self.max_ratio)


def match_mutual(a: Features, b: Features, max_ratio: float) -> Int[np.ndarray, "m 2"]:
    """Pairs of features that are each other's nearest, and much nearer than the second nearest, both ways.

    A pair is kept if distance < max_ratio * (distance to the second nearest) seen from a as well as from b, so that
    exchanging the photos exchanges the columns. Of equally near features neither is much nearer, so ties never
    match while max_ratio < 1; with max_ratio = 1 the lower index wins.

    Returns:
        Rows (index in a, index in b), by index in a.

    Source:
        `lowe2004`, section 7.1. Departure: the ratio is tested both ways.
    """
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
