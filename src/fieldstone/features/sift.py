"""SIFT keypoints with RootSIFT descriptors, spread over the photo."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from fieldstone.features.keypoints import find_keypoints
from fieldstone.scene.features import Features

ENLARGED = 2.0
"""Factor by which photos are enlarged to find faint features, so small that the detector's own doubling misses them."""

MAX_COARSE_RATIO = 0.8
"""Coarse detection at more than this ratio of the finest size would not be worth its time."""


@dataclass(frozen=True)
class SiftOptions:
    """What counts as a feature, and how many are kept."""

    max_features: int = 5000
    """More give no better poses on textured photos, and matching costs their square."""
    max_image_size: int = 1600
    """Photos whose longer side has more pixels are reduced to this before detection."""
    coarse_ratio: float = 0.65
    """Ratio of `max_image_size` at which features are detected first: less than half the time, and poses as exact."""
    enough_ratio: float = 0.6
    """Ratio of `max_features` from which on there is no finer detection."""
    contrast_threshold: float = 0.02
    """Least contrast of a feature, times 3 and relative to the full range of grey levels."""
    scarce: int = 600
    """A photo that shows fewer features, and less than enough, is searched again for faint ones."""
    faint_ratio: float = 0.25
    """Least contrast of a faint feature over that of others."""
    edge_threshold: float = 10.0
    """Largest ratio of the principal curvatures: larger ones lie along an edge and slide."""
    cells_per_axis: int = 8
    """Features compete for their place within the cells of a grid of this many rows and columns."""

    def __post_init__(self) -> None:
        if self.max_features < 1:
            raise ValueError(f"max_features must be at least 1, got {self.max_features}")
        if self.max_image_size < 1:
            raise ValueError(f"max_image_size must be at least 1 pixel, got {self.max_image_size}")
        if not 0 < self.coarse_ratio <= 1:
            raise ValueError(f"coarse_ratio must lie in (0, 1], got {self.coarse_ratio}")
        if not 0 <= self.enough_ratio <= 1:
            raise ValueError(f"enough_ratio must lie in [0, 1], got {self.enough_ratio}")
        if not 0 < self.contrast_threshold < 1:
            raise ValueError(f"contrast_threshold must lie in (0, 1), got {self.contrast_threshold}")
        if self.scarce < 0:
            raise ValueError(f"scarce must be at least 0 features, got {self.scarce}")
        if not 0 < self.faint_ratio <= 1:
            raise ValueError(f"faint_ratio must lie in (0, 1], got {self.faint_ratio}")
        if self.cells_per_axis < 1:
            raise ValueError(f"cells_per_axis must be at least 1, got {self.cells_per_axis}")


@dataclass(frozen=True)
class Sift:
    """Extractor: `Sift(options)(image)` gives the features of a photo, those of the largest scale first.

    One place may give several features, one for each dominant orientation.

    Source:
        `lowe2004`; the descriptor is that of `arandjelovic2012`, section 3.
    """

    options: SiftOptions = field(default_factory=SiftOptions)

    def __call__(self, image: UInt8[np.ndarray, "h w 3"], keep: Bool[np.ndarray, "h w"] | None = None) -> Features:
        """Features of an sRGB photo; keypoints and scales in pixels of the photo as given, corner convention.

        Args:
            keep: Features whose centre lies elsewhere are left out before the strongest are chosen; None: none is.
        """
        height, width = image.shape[:2]
        features = Features.none()
        for size in self.detection_sizes(width, height):
            features = self.detect(reduced_grey(image, size), image, (width, height), keep)
            if self.is_enough(features):
                break
        return self.detect_faint(image, (width, height), keep) if self.is_scarce(features) else features

    def detection_sizes(self, width: int, height: int) -> tuple[int, ...]:
        """Longer sides of the photo, from coarse to fine, at which features are detected until there are enough."""
        fine = min(self.options.max_image_size, max(width, height))
        coarse = max(round(self.options.coarse_ratio * self.options.max_image_size), 1)
        return (coarse, fine) if coarse < MAX_COARSE_RATIO * fine else (fine,)

    def is_enough(self, features: Features) -> bool:
        """Whether a finer detection is not worth its time."""
        return len(features) >= self.options.enough_ratio * self.options.max_features

    def is_scarce(self, features: Features) -> bool:
        """Whether a photo shows so little that faint features are worth their time."""
        return len(features) < self.options.scarce and not self.is_enough(features)

    def decides_otherwise(self, features: Features, rest: Features) -> bool:
        """Whether a photo would have been searched more closely, had it shown only the rest of its features."""
        return self.is_enough(features) > self.is_enough(rest) or self.is_scarce(rest) > self.is_scarce(features)

    def detect_faint(
        self, image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], keep: Bool[np.ndarray, "h w"] | None = None
    ) -> Features:
        """Features of low contrast too, down to the smallest: on the photo enlarged twice, up to `max_image_size`.

        Args:
            image: At full size.
            size, keep: As for `detect`.
        """
        options = self.options
        faint = replace(options, contrast_threshold=options.faint_ratio * options.contrast_threshold)
        grey = reduced_grey(image, options.max_image_size)
        factor = min(ENLARGED, options.max_image_size / max(grey.shape))
        if factor > 1.0:
            larger = round(grey.shape[1] * factor), round(grey.shape[0] * factor)
            grey = np.asarray(cv2.resize(grey, larger, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
        return Sift(faint).detect(grey, image, size, keep)

    def detect(
        self,
        grey: UInt8[np.ndarray, "gh gw"],
        image: UInt8[np.ndarray, "ih iw 3"],
        size: tuple[int, int],
        keep: Bool[np.ndarray, "h w"] | None = None,
    ) -> Features:
        """Features at one size of the photo.

        Args:
            grey: `reduced_grey` of the photo.
            image: Its colours, at any size.
            size: (width, height) of the photo, in whose pixels the features are given.
            keep: As for the call.
        """
        # Each axis of the photo was reduced by its own, rounded, factor.
        zoom = np.array(size) / np.array([grey.shape[1], grey.shape[0]])
        found = find_keypoints(grey, self.options.contrast_threshold, self.options.edge_threshold)
        if keep is not None:
            found = found[at_pixels(keep, found.xy * zoom)]
        # Features of one place only push others out: those that would not have been chosen alone are not among them.
        found = found[np.sort(spread(found.xy, found.contrast, grey.shape, self.options))]
        if not len(found):
            return Features.none()
        found, angle = found.oriented()
        chosen = spread(found.xy, found.contrast, grey.shape, self.options)
        order = chosen[np.lexsort((angle[chosen], found.xy[chosen, 0], found.xy[chosen, 1], -found.scale[chosen]))]
        found, angle = found[order], angle[order]
        pixels = np.clip(found.xy * zoom, 0.0, size)
        return Features(
            keypoints=pixels,
            scale=found.scale * float(np.sqrt(zoom.prod())),
            angle=angle,
            descriptors=found.described(angle),
            colors=at_pixels(image, pixels * (np.array([image.shape[1], image.shape[0]]) / np.array(size))),
        )


def reduced_grey(image: UInt8[np.ndarray, "h w 3"], max_size: int) -> UInt8[np.ndarray, "_ _"]:
    """Grey levels of an sRGB image with its longer side at most `max_size` pixels; never enlarged."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    factor = max_size / max(height, width)
    if factor < 1.0:
        size = max(round(width * factor), 1), max(round(height * factor), 1)
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(grey, dtype=np.uint8)


def spread(
    xy: Float[np.ndarray, "n 2"], response: Float[np.ndarray, "n"], shape: tuple[int, ...], options: SiftOptions
) -> Int[np.ndarray, "k"]:
    """Indices of at most `max_features` features: the strongest of every cell, then the second of every cell, ...

    Features of one place (several orientations) come in by their own strength; no cell with features starves.
    """
    if len(xy) <= options.max_features:
        return np.arange(len(xy))
    cells = options.cells_per_axis
    place = np.clip((xy * (cells / np.array([shape[1], shape[0]]))).astype(np.int64), 0, cells - 1)
    cell = place[:, 1] * cells + place[:, 0]
    by_cell = np.lexsort((xy[:, 0], xy[:, 1], -response, cell))
    first_of_cell = np.searchsorted(cell[by_cell], np.arange(cells * cells))
    rank = np.empty(len(xy), dtype=np.int64)
    rank[by_cell] = np.arange(len(xy)) - first_of_cell[cell[by_cell]]
    return np.lexsort((xy[:, 0], xy[:, 1], -response, rank))[: options.max_features]


def at_pixels(image: Shaped[np.ndarray, "h w *c"], pixels: Float[np.ndarray, "n 2"]) -> Shaped[np.ndarray, "n *c"]:
    """Value of the pixel in which each position lies."""
    column = np.clip(pixels[:, 0].astype(np.int64), 0, image.shape[1] - 1)
    row = np.clip(pixels[:, 1].astype(np.int64), 0, image.shape[0] - 1)
    return image[row, column]
