"""Local features of one photo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints with descriptors, row k of every array for feature k.

    keypoints: (x, y) in pixels, corner convention. scale: radius in pixels. angle: radians.
    descriptors: for SIFT 128 values, RootSIFT times 512 as uint8. colors: sRGB at the keypoint.
    """

    keypoints: Float[np.ndarray, "n 2"]
    scale: Float[np.ndarray, "n"]
    angle: Float[np.ndarray, "n"]
    descriptors: UInt8[np.ndarray, "n d"]
    colors: UInt8[np.ndarray, "n 3"]

    @staticmethod
    def none() -> Features:
        """Features of a photo that shows nothing."""
        no_bytes = np.empty((0, 128), dtype=np.uint8)
        return Features(np.empty((0, 2)), np.empty(0), np.empty(0), no_bytes, np.empty((0, 3), dtype=np.uint8))

    def __len__(self) -> int:
        return len(self.keypoints)

    def __getitem__(self, index) -> Features:
        """The features of an index array or mask."""
        return Features(
            self.keypoints[index],
            self.scale[index],
            self.angle[index],
            self.descriptors[index],
            self.colors[index],
        )
