"""Black borders that undistortion leaves around photos: not part of the scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.ndimage import binary_dilation, label

MAX_LEVEL = 8
"""A black that was saved as JPEG is not quite 0."""

MIN_PHOTOS = 3
"""Fewer photos may all be dark at one place by chance."""

MAX_FRACTION = 0.15
"""More than this share of a photo is no border but a dark scene."""

BLEND_PX = 2
"""Pixels beside the border are mixtures."""


def kept_inside_borders(photos: Sequence[UInt8[np.ndarray, "h w _"]]) -> Bool[np.ndarray, "h w"] | None:
    """The pixels inside of the border that all photos of one camera share; None: there is no border.

    The border of an undistorted photo depends on the lens alone: it is where all photos are black, and it touches the
    edges.

    Args:
        photos: Pixels of the photos of one camera.
    """
    if len(photos) < MIN_PHOTOS or any(pixels.shape[2] == 4 for pixels in photos):
        return None
    black = np.logical_and.reduce([pixels.max(axis=2) <= MAX_LEVEL for pixels in photos])
    regions = np.zeros(black.shape, dtype=np.int32)
    label(black, output=regions)
    edges = np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]])
    border = np.isin(regions, np.unique(edges[edges > 0]))
    if not border.any() or border.mean() > MAX_FRACTION:
        return None
    return np.logical_not(binary_dilation(border, iterations=BLEND_PX))
