"""Matching along epipolar lines without looking at the features far from them."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fieldstone.features.matching import mutual_and_distinct
from fieldstone.features.nearest import NO_SECOND, TwoNearest
from fieldstone.scene.features import Features

STRIP_PX = 160.0
"""Keypoints are filed in upright strips of this width, from top to bottom within each."""


def match_guided_numba(
    a: Features, b: Features, image2_F_image1: Float[np.ndarray, "3 3"], max_error_px: float, max_ratio: float
) -> Int[np.ndarray, "m 2"]:
    """`guided.match_guided` by a walk along each epipolar line through the strips of the other photo."""
    if not len(a) or not len(b):
        return np.empty((0, 2), dtype=np.int64)
    left = float(b.keypoints[:, 0].min())
    strip = ((b.keypoints[:, 0] - left) / STRIP_PX).astype(np.int64)
    order = np.lexsort((b.keypoints[:, 1], strip))
    strip_start = np.searchsorted(strip[order], np.arange(int(strip.max()) + 2))
    from_a, from_b = _none_yet(len(a)), _none_yet(len(b))
    _rank_along_lines(
        np.ascontiguousarray(a.keypoints),
        np.ascontiguousarray(a.descriptors),
        np.ascontiguousarray(b.keypoints[order]),
        np.ascontiguousarray(b.descriptors[order]),
        order,
        strip_start,
        left,
        np.ascontiguousarray(image2_F_image1, dtype=np.float64),
        max_error_px,
        from_a,
        from_b,
    )
    return mutual_and_distinct(TwoNearest(*from_a), TwoNearest(*from_b), max_ratio)


def _none_yet(n: int) -> Int[np.ndarray, "3 n"]:
    """Index, squared distance of the nearest and of the second nearest."""
    return np.repeat(np.array([[-1], [NO_SECOND], [NO_SECOND]], dtype=np.int64), n, axis=1)


@njit(cache=True)
@no_type_check
def _band(la, lb, lc, x0, x1, width):
    """Range of y outside of which |la x + lb y + lc| > width for all x in [x0, x1]."""
    low, high = min(la * x0, la * x1) + lc, max(la * x0, la * x1) + lc
    if lb == 0.0:
        return (np.inf, -np.inf) if low > width or high < -width else (-np.inf, np.inf)
    p, q = (-width - high) / lb, (width - low) / lb
    # Half a pixel more: the exact test decides, not the rounding of this one.
    return min(p, q) - 0.5, max(p, q) + 0.5


@njit(cache=True)
@no_type_check
def _enter(ranking, i, other, distance):
    """Compare one more distance with the best two of feature i; of equal ones the lower index wins."""
    if distance < ranking[1, i] or (distance == ranking[1, i] and other < ranking[0, i]):
        ranking[2, i] = ranking[1, i]
        ranking[1, i] = distance
        ranking[0, i] = other
    elif distance < ranking[2, i]:
        ranking[2, i] = distance


@njit(cache=True, nogil=True)
@no_type_check
def _rank_along_lines(pixels_a, bytes_a, pixels_b, bytes_b, order, strip_start, left, F, max_error, from_a, from_b):
    """Fill the rankings (3, n) and (3, m).  b sorted by strip, then y; order (m).

    Near the line of the other is near both ways, so that one distance serves both rankings.
    """
    for i in range(pixels_a.shape[0]):
        x, y = pixels_a[i, 0], pixels_a[i, 1]
        la = F[0, 0] * x + F[0, 1] * y + F[0, 2]
        lb = F[1, 0] * x + F[1, 1] * y + F[1, 2]
        lc = F[2, 0] * x + F[2, 1] * y + F[2, 2]
        width2 = max_error * np.sqrt(la * la + lb * lb)
        for s in range(strip_start.shape[0] - 1):
            first, last = strip_start[s], strip_start[s + 1]
            if first == last:
                continue
            x0, x1 = left + s * STRIP_PX, left + (s + 1) * STRIP_PX
            top, bottom = _band(la, lb, lc, x0, x1, width2)
            if pixels_b[last - 1, 1] < top or pixels_b[first, 1] > bottom:
                continue
            while first < last:
                middle = (first + last) // 2
                if pixels_b[middle, 1] < top:
                    first = middle + 1
                else:
                    last = middle
            for k in range(first, strip_start[s + 1]):
                u, v = pixels_b[k, 0], pixels_b[k, 1]
                if v > bottom:
                    break
                offset = abs(la * u + lb * v + lc)
                if offset > width2:
                    continue
                ma = F[0, 0] * u + F[1, 0] * v + F[2, 0]
                mb = F[0, 1] * u + F[1, 1] * v + F[2, 1]
                if offset > max_error * np.sqrt(ma * ma + mb * mb):
                    continue
                distance = 0
                for d in range(bytes_a.shape[1]):
                    difference = np.int32(bytes_a[i, d]) - np.int32(bytes_b[k, d])
                    distance += difference * difference
                _enter(from_a, i, order[k], distance)
                _enter(from_b, order[k], i, distance)
