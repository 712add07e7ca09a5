"""The two nearest neighbours of every descriptor, both ways: the readable reference of `nearest_numba`.

Descriptors are bytes, so squared distances are integers: every implementation gives the same answer, to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int, UInt8

BLOCK = 1024
"""Rows of the distance matrix that are held at once."""
MAX_DIMENSIONS = 256
"""Up to this many, float32 sums of products of two bytes are exact: 256 * 255^2 < 2^24."""
NO_SECOND = 2**29
"""Stands for the distance of a second neighbour that does not exist; larger than any real one."""


@dataclass(frozen=True, eq=False)
class TwoNearest:
    """For each feature of one photo: the nearest of the other, and the squared distances of the nearest two."""

    index: Int[np.ndarray, "n"]
    """-1 where no feature of the other photo was allowed."""
    nearest: Int[np.ndarray, "n"]
    second: Int[np.ndarray, "n"]
    """`NO_SECOND` where the other photo has one feature only."""

    def distinct(self, max_ratio: float) -> Bool[np.ndarray, "n"]:
        """Whether the nearest is closer than `max_ratio` times the second nearest (1: no test)."""
        if max_ratio >= 1.0:
            return np.ones(len(self.index), dtype=bool)
        return self.nearest < max_ratio**2 * self.second


def two_nearest(a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"]) -> tuple[TwoNearest, TwoNearest]:
    """The two nearest neighbours of each row of a in b, and of each row of b in a; lower indices win ties."""
    check_descriptors(a, b)
    return _nearest_rows(a, b), _nearest_rows(b, a)


def check_descriptors(a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d2"]) -> None:
    """Raise unless both have rows, of the same and not too large number of values."""
    if not len(a) or not len(b):
        raise ValueError(f"nearest neighbours need features in both photos, got {len(a)} and {len(b)}")
    if a.shape[1] != b.shape[1] or a.shape[1] > MAX_DIMENSIONS:
        raise ValueError(
            f"descriptors must have the same number of values, at most {MAX_DIMENSIONS}: {a.shape[1]}, {b.shape[1]}"
        )


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
