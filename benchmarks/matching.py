"""Exact matching of two photos: ours against a float product with scans, and OpenCV.

`python -m benchmarks.matching [PHOTO_A PHOTO_B] [--out ROWS.json]` prints CPU seconds (best and median), matches, and
how many of them are the reference's. One thread, descriptors in memory; the median of the runs is the figure to quote.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from threadpoolctl import threadpool_limits

from benchmarks.data import DATA, present
from benchmarks.rows import QUALITY, TIMES, Row, add_out_option, write_rows
from fieldstone.features.matching import mutual_and_distinct
from fieldstone.features.nearest import two_nearest
from fieldstone.features.nearest_numba import two_nearest_numba
from fieldstone.features.sift import Sift, SiftOptions

MAX_RATIO = 0.8
DEFAULT_PHOTOS = [DATA / "strecha_fountain_p11" / "images" / f"000{k}.jpg" for k in (4, 5)]


@dataclass(frozen=True)
class Measured:
    """CPU seconds of each run, and the matches (pairs of rows)."""

    seconds: list[float]
    matches: set[tuple[int, int]]


def main() -> None:
    """Measure and print one line for each implementation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photos", type=Path, nargs="*", default=DEFAULT_PHOTOS, help="two photos")
    parser.add_argument("--features", type=int, default=8192)
    parser.add_argument("--runs", type=int, default=7)
    add_out_option(parser, "matching")
    options = parser.parse_args()
    if len(options.photos) != 2:
        parser.error(f"two photos are matched, got {len(options.photos)}")
    if len(present(options.photos)) < 2:
        return
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        extractor = Sift(SiftOptions(max_features=options.features))
        a, b = (extractor(np.asarray(Image.open(p).convert("RGB"))).descriptors for p in options.photos)
        sys.stdout.write(f"{len(a)} x {len(b)} descriptors, CPU seconds on one thread\n")
        two_nearest_numba(a[:16], b[:16])  # compile
        reference = measure("numpy reference", lambda: two_nearest_rows(a, b), 1, None).matches
        ours = measure("fieldstone", lambda: compiled(a, b), options.runs, reference)
        product = measure("numpy float product and scans", lambda: product_and_scans(a, b), options.runs, reference)
        measure("OpenCV brute force, both ways", lambda: opencv(a, b), 1, reference)
    ours_s, product_s = (statistics.median(each.seconds) for each in (ours, product))
    same = len(ours.matches & reference) / len(reference)
    rows = [
        Row("matching/cpu", ours_s, "s", "lower", TIMES, "numpy float product", product_s),
        Row("matching/matches of the reference", same, "share", "higher", QUALITY),
    ]
    write_rows(rows, options.out)


def measure(name: str, run: Callable[[], np.ndarray], runs: int, reference: set[tuple[int, int]] | None) -> Measured:
    """Time an implementation and print a line."""
    seconds, matches = [], np.empty((0, 2), dtype=np.int64)
    for _ in range(runs):
        start = time.process_time()
        matches = run()
        seconds.append(time.process_time() - start)
    rows: set[tuple[int, int]] = {(int(i), int(j)) for i, j in matches}
    same = len(rows if reference is None else rows & reference)
    sys.stdout.write(
        f"{name:32s} best {min(seconds):6.3f}  median {statistics.median(seconds):6.3f}  "
        f"{len(rows)} matches, {same} of the reference's\n"
    )
    return Measured(seconds, rows)


def compiled(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """What the pipeline runs."""
    return mutual_and_distinct(*two_nearest_numba(a, b), MAX_RATIO)


def two_nearest_rows(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The readable reference."""
    return mutual_and_distinct(*two_nearest(a, b), MAX_RATIO)


def product_and_scans(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """One float32 product, then the largest two of each row and column: the plain fast way in numpy."""
    fa, fb = a.astype(np.float32), b.astype(np.float32)
    norm_a, norm_b = np.einsum("nd,nd->n", fa, fa), np.einsum("nd,nd->n", fb, fb)
    distance = norm_a[:, None] + norm_b - 2 * (fa @ fb.T)
    nearest = []
    for axis in (1, 0):
        index = distance.argmin(axis=axis)
        at = (np.arange(len(a)), index) if axis == 1 else (index, np.arange(len(b)))
        first = distance[at].copy()
        distance[at] = np.inf
        second = distance.min(axis=axis)
        distance[at] = first
        nearest.append((index, first < MAX_RATIO**2 * second))
    (to_b, good_a), (to_a, good_b) = nearest
    i = np.flatnonzero(good_a & good_b[to_b] & (to_a[to_b] == np.arange(len(a))))
    return np.stack([i, to_b[i]], axis=1)


def opencv(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """OpenCV's brute-force matcher with the ratio test, both ways."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    fa, fb = a.astype(np.float32), b.astype(np.float32)

    def one_way(x: np.ndarray, y: np.ndarray) -> dict[int, int]:
        found = matcher.knnMatch(x, y, k=2)
        return {p.queryIdx: p.trainIdx for p, q in found if p.distance < MAX_RATIO * q.distance}

    forward, backward = one_way(fa, fb), one_way(fb, fa)
    return np.array([(i, j) for i, j in sorted(forward.items()) if backward.get(j) == i], dtype=np.int64)


if __name__ == "__main__":
    main()
