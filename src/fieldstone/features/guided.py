"""Matching along epipolar lines, once the geometry of a pair is known: the readable reference of `guided_numba`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.features.matching import mutual_and_distinct
from fieldstone.features.nearest import NO_SECOND, TwoNearest, squared_distances
from fieldstone.geometry.epipolar import homogeneous
from fieldstone.scene.features import Features


def match_guided(
    a: Features, b: Features, image2_F_image1: Float[np.ndarray, "3 3"], max_error_px: float, max_ratio: float
) -> Int[np.ndarray, "m 2"]:
    """Mutual nearest neighbours with ratio test among the pairs that agree with a fundamental matrix.

    A pair agrees if each keypoint lies within `max_error_px` of the epipolar line of the other. Features compete
    with those near their line only, so that repeated structure elsewhere no longer fails the ratio test.

    Returns:
        Rows (index in a, index in b), by index in a.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), dtype=np.int64)
    agrees = near_epipolar_lines(a.keypoints, b.keypoints, image2_F_image1, max_error_px)
    distances = np.where(agrees, squared_distances(a.descriptors, b.descriptors), NO_SECOND)
    return mutual_and_distinct(_two_nearest(distances), _two_nearest(distances.T), max_ratio)


def near_epipolar_lines(
    pixels1: Float[np.ndarray, "n 2"],
    pixels2: Float[np.ndarray, "m 2"],
    F: Float[np.ndarray, "3 3"],
    max_error_px: float,
) -> Bool[np.ndarray, "n m"]:
    """Which pairs of pixels lie within `max_error_px` of each other's epipolar lines."""
    lines2, lines1 = homogeneous(pixels1) @ F.T, homogeneous(pixels2) @ F
    offset = np.abs(lines2 @ homogeneous(pixels2).T)
    width2 = max_error_px * np.linalg.norm(lines2[:, :2], axis=1)
    width1 = max_error_px * np.linalg.norm(lines1[:, :2], axis=1)
    return (offset <= width2[:, None]) & (offset <= width1)


def _two_nearest(distances: Int[np.ndarray, "n m"]) -> TwoNearest:
    """Per row the nearest and the second; index -1 where no pair of the row agrees."""
    rows = np.arange(len(distances))
    index = np.argmin(distances, axis=1)
    nearest = distances[rows, index]
    rest = distances.copy()
    rest[rows, index] = NO_SECOND
    return TwoNearest(np.where(nearest < NO_SECOND, index, -1), nearest, rest.min(axis=1))
