"""Photos as nodes, matches between them as edges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.geometry.rigid3 import Rigid3

ImagePair = tuple[int, int]
"""Indices (i, j) of two photos, i < j."""

TwoViewKind = Literal["calibrated", "uncalibrated", "planar", "panoramic", "degenerate"]


@dataclass(frozen=True, eq=False)
class TwoView:
    """What is known of one pair: its geometry and which of its matches agree with it.

    matrix: the essential matrix `cam2_E_cam1` (calibrated), the fundamental matrix (uncalibrated), or the
    homography `image2_H_image1` (planar, panoramic). cam2_from_cam1: |t| = 1, or t = 0 for panoramic pairs.
    """

    kind: TwoViewKind
    matrix: Float[np.ndarray, "3 3"]
    cam2_from_cam1: Rigid3 | None
    inliers: Bool[np.ndarray, "m"]


@dataclass(frozen=True, eq=False)
class MatchGraph:
    """Keypoints of every photo and the matches of every pair.

    matches: row (a, b) says that keypoint a of photo i and keypoint b of photo j may show one point. They are
    putative: `inlier_matches` gives those that agree with the pair's `TwoView` geometry, where there is one.
    keypoints are in pixels of the photo, corner convention.
    pixel_scale: per photo, how many of its pixels count as one in every threshold and error: pixels of the photo per
    pixel of the detector, which worked on a reduced photo. None: one everywhere.
    """

    names: tuple[str, ...]
    keypoints: tuple[Float[np.ndarray, "_ 2"], ...]
    colors: tuple[UInt8[np.ndarray, "_ 3"], ...]
    matches: Mapping[ImagePair, Int[np.ndarray, "_ 2"]]
    two_views: Mapping[ImagePair, TwoView] = field(default_factory=dict)
    pixel_scale: Float[np.ndarray, "n"] | None = None

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.keypoints) == len(self.colors):
            raise ValueError(
                f"a match graph needs one name, keypoint and colour array per photo, got "
                f"{len(self.names)}, {len(self.keypoints)}, {len(self.colors)}"
            )
        if self.pixel_scale is not None and self.pixel_scale.shape != (len(self.names),):
            raise ValueError(f"{len(self.names)} photos need as many pixel scales, got {self.pixel_scale.shape}")
        for i, j in self.matches:
            if not 0 <= i < j < len(self.names):
                raise ValueError(f"pair ({i}, {j}) is not two photos i < j of {len(self.names)}")

    @property
    def num_images(self) -> int:
        """Number of photos, matched or not."""
        return len(self.names)

    @property
    def scale_of_image(self) -> Float[np.ndarray, "n"]:
        """`pixel_scale`, with the ones that None stands for."""
        return np.ones(self.num_images) if self.pixel_scale is None else self.pixel_scale

    def inlier_matches(self, pair: ImagePair) -> Int[np.ndarray, "m 2"]:
        """Matches that agree with the pair's geometry; all of them while it has none."""
        two_view = self.two_views.get(pair)
        return self.matches[pair] if two_view is None else self.matches[pair][two_view.inliers]

    def matched_pixels(
        self, pair: ImagePair, matches: Int[np.ndarray, "m 2"] | None = None
    ) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
        """Pixels of the pair's matches (by default all putative ones) in the first and the second photo."""
        rows = self.matches[pair] if matches is None else matches
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]

    def with_two_views(self, two_views: Mapping[ImagePair, TwoView]) -> MatchGraph:
        """The same graph with verified pairs."""
        return replace(self, two_views=dict(two_views))
