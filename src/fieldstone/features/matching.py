"""Mutual nearest neighbours with a ratio test: the readable reference of `matching_numba`.

Descriptors are uint8, so squared distances are integers below 2^24: float32 products of 128 terms are exact, and
every implementation gives the same matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.scene.features import Features

BLOCK = 1024
"""Rows of the distance matrix that are held at once."""


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
    from_a, from_b = two_nearest(a.descriptors, b.descriptors)
    return mutual_and_distinct(from_a, from_b, max_ratio)


@dataclass(frozen=True, eq=False)
class TwoNearest:
    """For each feature of one photo: the nearest of the other, and the squared distances of the nearest two."""

    index: Int[np.ndarray, "n"]
    nearest: Int[np.ndarray, "n"]
    second: Int[np.ndarray, "n"]
    """`NO_SECOND` where the other photo has one feature only."""

    def distinct(self, max_ratio: float) -> Bool[np.ndarray, "n"]:
        """Whether the nearest is closer than `max_ratio` times the second nearest (1: no test)."""
        if max_ratio >= 1.0:
            return np.ones(len(self.index), dtype=bool)
        return self.nearest < max_ratio**2 * self.second


NO_SECOND = 2**24
"""More than any squared distance of 128 bytes."""


def two_nearest(a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"]) -> tuple[TwoNearest, TwoNearest]:
    """The two nearest neighbours of each row of a in b, and of each row of b in a; lower indices win ties."""
    return _nearest_rows(a, b), _nearest_rows(b, a)


def _nearest_rows(a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"]) -> TwoNearest:
    blocks = [_two_smallest(squared_distances(a[k : k + BLOCK], b)) for k in range(0, len(a), BLOCK)]
    index, nearest, second = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return TwoNearest(index, nearest, second)


def squared_distances(a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"]) -> Int[np.ndarray, "n m"]:
    """|a_i - b_j|^2 = |a_i|^2 + |b_j|^2 - 2 a_i . b_j, exact."""
    fa, fb = a.astype(np.float32), b.astype(np.float32)
    dots = (fa @ fb.T).astype(np.int64)
    return squared_norms(a)[:, None] + squared_norms(b) - 2 * dots


def squared_norms(a: UInt8[np.ndarray, "n d"]) -> Int[np.ndarray, "n"]:
    """|a_i|^2, exact."""
    return np.einsum("nd,nd->n", a, a, dtype=np.int64)


def _two_smallest(
    distances: Int[np.ndarray, "n m"],
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Column of the smallest value of each row (the first of several), and the two smallest values."""
    rows = np.arange(len(distances))
    index = np.argmin(distances, axis=1)
    nearest = distances[rows, index]
    if distances.shape[1] == 1:
        return index, nearest, np.full(len(distances), NO_SECOND)
    rest = distances.copy()
    rest[rows, index] = NO_SECOND
    return index, nearest, rest.min(axis=1)


def mutual_and_distinct(from_a: TwoNearest, from_b: TwoNearest, max_ratio: float) -> Int[np.ndarray, "m 2"]:
    """Pairs that chose each other and pass the ratio test both ways, by index in a."""
    i = np.arange(len(from_a.index))
    j = from_a.index
    good = (from_b.index[j] == i) & from_a.distinct(max_ratio) & from_b.distinct(max_ratio)[j]
    return np.stack([i[good], j[good]], axis=1).astype(np.int64)


def descriptor_distances(
    a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"], matches: Int[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k"]:
    """Euclidean distance between the descriptors of each match."""
    difference = a[matches[:, 0]].astype(np.float64) - b[matches[:, 1]]
    return np.linalg.norm(difference, axis=1)
