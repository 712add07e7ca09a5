"""Features of photos: ours against OpenCV's SIFT with the same options, in turn on the same grey levels.

`python -m benchmarks.detection [PHOTO ...] [--size 1040] [--runs 5] [--out ROWS.json]` prints CPU seconds of all photos
on one thread (median), features, and matches of neighbouring photos that agree with one fundamental matrix.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from threadpoolctl import threadpool_limits

from benchmarks.data import DATA, present
from benchmarks.rows import QUALITY, TIMES, Row, add_out_option, write_rows
from fieldstone.features.matching import match_mutual
from fieldstone.features.sift import Sift, SiftOptions, reduced_grey, spread
from fieldstone.io.images.photos import read_photo
from fieldstone.scene.features import Features

MAX_RATIO = 0.8
MAX_ERROR_PX = 1.0
CANDIDATES = 1.6
"""OpenCV describes whatever it finds: so many times `max_features`, of which those are kept that ours would keep."""
DEFAULT_PHOTOS = [DATA / "strecha_fountain_p11" / "images" / f"{k:04d}.jpg" for k in range(3, 7)]


def main() -> None:
    """Measure, print one line for each side, and write rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="*", default=DEFAULT_PHOTOS)
    parser.add_argument("--size", type=int, default=1040, help="longer side of the photos, in pixels")
    parser.add_argument("--runs", type=int, default=5)
    add_out_option(parser, "detection")
    given = parser.parse_args()
    if len(photos := present(given.photos)) < 2:
        return
    options = SiftOptions()
    images = [read_photo(path, at_least_px=given.size).rgb for path in photos]
    greys = [reduced_grey(image, given.size) for image in images]
    sides = {"fieldstone": lambda k: ours(greys[k], images[k], options), "OpenCV": lambda k: theirs(greys[k], options)}
    seconds: dict[str, list[float]] = {side: [] for side in sides}
    found: dict[str, list[Features]] = {}
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        ours(greys[0][:64, :64], images[0], options)  # compile
        for _ in range(given.runs):
            for side, detect in sides.items():
                start = time.process_time()
                found[side] = [detect(k) for k in range(len(greys))]
                seconds[side].append(time.process_time() - start)
    median = {side: statistics.median(each) for side, each in seconds.items()}
    inliers = {side: sum(agreeing(a, b) for a, b in pairwise(each)) for side, each in found.items()}
    for side in sides:
        count = sum(map(len, found[side]))
        sys.stdout.write(
            f"{side:12s} {median[side]:6.3f} s for {len(greys)} photos of {given.size} px, {count} features, "
            f"{inliers[side]} matches agree\n"
        )
    peer = "OpenCV SIFT"
    rows = [
        Row("detection/cpu", median["fieldstone"], "s", "lower", TIMES, peer, median["OpenCV"]),
        Row(
            "detection/matches that agree", inliers["fieldstone"], "matches", "higher", QUALITY, peer, inliers["OpenCV"]
        ),
    ]
    write_rows(rows, given.out)


def ours(grey: UInt8[np.ndarray, "gh gw"], image: UInt8[np.ndarray, "h w 3"], options: SiftOptions) -> Features:
    """What the pipeline runs, in pixels of the grey levels."""
    return Sift(options).detect(grey, image, (grey.shape[1], grey.shape[0]))


def theirs(grey: UInt8[np.ndarray, "gh gw"], options: SiftOptions) -> Features:
    """OpenCV's, with RootSIFT descriptors, spread over the photo in the same way."""
    detector = cv2.SIFT.create(
        nfeatures=round(CANDIDATES * options.max_features),
        nOctaveLayers=3,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        sigma=1.6,
        descriptorType=cv2.CV_8U,
        enable_precise_upscale=True,
    )
    found, described = detector.detectAndCompute(grey, None)
    xy = np.array([k.pt for k in found]) + 0.5
    kept = spread(xy, np.array([k.response for k in found]), grey.shape, options)
    values = np.asarray(described, dtype=np.float32)[kept]
    shares = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    return Features(
        keypoints=xy[kept],
        scale=np.array([k.size for k in found])[kept] / 2,
        angle=np.deg2rad([k.angle for k in found])[kept],
        descriptors=np.minimum(np.rint(512.0 * np.sqrt(shares)), 255.0).astype(np.uint8),
        colors=np.zeros((len(kept), 3), dtype=np.uint8),
    )


def agreeing(a: Features, b: Features) -> int:
    """Matches of two photos that one fundamental matrix explains."""
    rows = match_mutual(a, b, MAX_RATIO)
    if len(rows) < 8:
        return 0
    x, y = (f.keypoints[rows[:, k]].astype(np.float32) for k, f in enumerate((a, b)))
    _, mask = cv2.findFundamentalMat(x, y, cv2.USAC_MAGSAC, MAX_ERROR_PX, 0.9999, 10_000)
    return 0 if mask is None else int(mask.sum())


if __name__ == "__main__":
    main()
