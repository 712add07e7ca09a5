"""The normalised 8-point algorithm for the fundamental matrix, and its RANSAC estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.epipolar import homogeneous


def fundamental_eight_point(
    pixels1: Float[np.ndarray, "*b n 2"], pixels2: Float[np.ndarray, "*b n 2"]
) -> Float[np.ndarray, "*b 3 3"]:
    """image2_F_image1 from n >= 8 matches, of rank 2 and unit norm; any number of batch axes.

    Both photos are moved and scaled first so that their points have centroid 0 and mean distance sqrt(2): without it
    the linear system mixes entries of size 1 and 10^6. Then A f = 0 in the least-squares sense, and the smallest
    singular value of F is set to 0, so that all epipolar lines meet in the epipoles.

    Matches on a plane, or from a camera that only turned, leave F undetermined: the result then satisfies the matches
    but is one of a family. Fewer than 8 different matches likewise.

    Raises:
        ValueError: Fewer than 8 matches.

    Source:
        `hartley1997`; `hartley2004`, algorithm 11.1.
    """
    if pixels1.shape[-2] < 8:
        raise ValueError(f"the 8-point algorithm needs 8 matches, got {pixels1.shape[-2]}")
    x1, T1 = normalized(pixels1)
    x2, T2 = normalized(pixels2)
    ones_x1 = homogeneous_last(x1)
    A = np.concatenate([x2[..., :1] * ones_x1, x2[..., 1:] * ones_x1, ones_x1], axis=-1)
    F = _null_vector(A).reshape(*A.shape[:-2], 3, 3)
    U, d, Vt = np.linalg.svd(F)
    d[..., 2] = 0.0
    F = np.swapaxes(T2, -1, -2) @ ((U * d[..., None, :]) @ Vt) @ T1
    return F / np.linalg.norm(F, axis=(-2, -1), keepdims=True)


def normalized(
    points: Float[np.ndarray, "*b n d"],
) -> tuple[Float[np.ndarray, "*b n d"], Float[np.ndarray, "*b e e"]]:
    """Points moved to centroid 0 and mean distance sqrt(d), and the homogeneous transform that does it.

    Source:
        `hartley2004`, algorithm 4.2.
    """
    d = points.shape[-1]
    centroid = points.mean(axis=-2, keepdims=True)
    distance = np.linalg.norm(points - centroid, axis=-1).mean(axis=-1)
    scale = np.sqrt(d) / np.where(distance > 0, distance, 1.0)
    T = np.zeros((*points.shape[:-2], d + 1, d + 1))
    T[..., np.arange(d), np.arange(d)] = scale[..., None]
    T[..., :d, d] = -scale[..., None] * centroid[..., 0, :]
    T[..., d, d] = 1.0
    return (points - centroid) * scale[..., None, None], T


def homogeneous_last(points: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n e"]:
    """Append a one to the last axis."""
    return np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)


@dataclass(frozen=True, eq=False)
class FundamentalEstimator:
    """RANSAC over fundamental matrices: samples of 8 matches, Sampson error in pixels.

    Source:
        `hartley2004`, algorithm 11.4.
    """

    pixels1: Float[np.ndarray, "n 2"]
    pixels2: Float[np.ndarray, "n 2"]
    sample_size: int = 8

    @property
    def num_data(self) -> int:
        """Number of matches."""
        return len(self.pixels1)

    def fit_minimal(self, samples: Int[np.ndarray, "k s"]) -> Float[np.ndarray, "k 3 3"]:
        """One F per sample."""
        return fundamental_eight_point(self.pixels1[samples], self.pixels2[samples])

    def squared_errors(self, models: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m n"]:
        """Squared Sampson error in pixels; see `geometry.epipolar.sampson_error`."""
        x1, x2 = homogeneous(self.pixels1), homogeneous(self.pixels2)
        lines2 = x1 @ np.swapaxes(models, 1, 2)
        lines1 = x2 @ models
        numerator = np.sum(x2 * lines2, axis=2) ** 2
        denominator = np.sum(lines2[..., :2] ** 2, axis=2) + np.sum(lines1[..., :2] ** 2, axis=2)
        return numerator / np.maximum(denominator, 1e-300)

    def refit(self, inliers: Int[np.ndarray, "i"]) -> Float[np.ndarray, "1 3 3"]:
        """F of all inliers."""
        return fundamental_eight_point(self.pixels1[inliers], self.pixels2[inliers])[None]


def _null_vector(A: Float[np.ndarray, "*b n 9"]) -> Float[np.ndarray, "*b 9"]:
    """Right singular vector of the smallest singular value, through the 9 x 9 triangular factor of A."""
    if A.shape[-2] == 8:  # a row of zeros makes the factor square, and keeps its null vector
        A = np.concatenate([A, np.zeros_like(A[..., :1, :])], axis=-2)
    return np.linalg.svd(np.linalg.qr(A, mode="r"))[2][..., -1, :]
