"""Keypoints of one photo, with what they are described by: the octaves of its scale space."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.features.blur_numba import blurred_numba, gaussian_weights
from fieldstone.features.descriptors_numba import (
    DESCRIPTOR_SIDE,
    DESCRIPTOR_SIZE,
    MAX_ORIENTATIONS,
    ORIENTATION_SIDE,
    cell_weights,
    descriptors_numba,
    orientation_weights,
    orientations_numba,
    sample_grid,
)
from fieldstone.features.scale_space_numba import (
    BORDER,
    LAYERS,
    SIGMA,
    empty_levels,
    octave_extrema_numba,
    octave_weights,
)

PHOTO_SIGMA = 0.5
"""Blur that a photo is taken to have, in its pixels."""
ENLARGED = 2
"""The first octave is of the photo enlarged by this: half of all keypoints are too small to be seen in it as it is."""
GREY_LEVELS = 255.0

Octave = tuple[Float[np.ndarray, "_ _"], ...]
"""Images 1 to `LAYERS` of an octave."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Extrema of the scale space of one photo, row k of every array for keypoint k.

    octave: index into `octaves`. at: (x, y, level, contrast) in it, where whole numbers are the centres of pixels.
    """

    octaves: tuple[Octave, ...]
    octave: Int[np.ndarray, "n"]
    at: Float[np.ndarray, "n 4"]

    def __len__(self) -> int:
        return len(self.octave)

    def __getitem__(self, index) -> Keypoints:
        """The keypoints of an index array or mask."""
        return Keypoints(self.octaves, self.octave[index], self.at[index])

    @property
    def xy(self) -> Float[np.ndarray, "n 2"]:
        """In pixels of the photo, corner convention."""
        # An octave has every second pixel of the one before, from the first one on.
        return (self.at[:, :2] * 2.0 ** self.octave[:, None] + 0.5) / ENLARGED

    @property
    def scale(self) -> Float[np.ndarray, "n"]:
        """The blur at which a keypoint stands out most, in pixels of the photo."""
        return SIGMA * 2.0 ** (self.octave + self.at[:, 2] / LAYERS) / ENLARGED

    @property
    def contrast(self) -> Float[np.ndarray, "n"]:
        """Of the differences between images, in grey levels."""
        return self.at[:, 3]

    def oriented(self) -> tuple[Keypoints, Float[np.ndarray, "m"]]:
        """Each keypoint once for every of its orientations, and these, in radians from x towards y."""
        count = np.zeros(len(self), dtype=np.int64)
        angles = np.zeros((len(self), MAX_ORIENTATIONS))
        grid, weights = sample_grid(ORIENTATION_SIDE), orientation_weights()
        for k, rows in self._of_octaves():
            angles_of_octave = np.zeros((len(rows), MAX_ORIENTATIONS))
            count[rows] = orientations_numba(self.octaves[k], self.at[rows], grid, weights, angles_of_octave)
            angles[rows] = angles_of_octave
        return self[np.repeat(np.arange(len(self)), count)], angles[np.arange(MAX_ORIENTATIONS) < count[:, None]]

    def described(self, angles: Float[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 128"]:
        """RootSIFT descriptors at these angles."""
        out = np.zeros((len(self), DESCRIPTOR_SIZE), dtype=np.uint8)
        grid, weights = sample_grid(DESCRIPTOR_SIDE), cell_weights()
        for k, rows in self._of_octaves():
            out[rows] = descriptors_numba(self.octaves[k], self.at[rows], angles[rows], grid, weights)
        return out

    def _of_octaves(self) -> list[tuple[int, Int[np.ndarray, "_"]]]:
        """The octaves that have keypoints, and these from top to bottom, so that they look at what is in the cache."""
        from_top = np.lexsort((self.at[:, 1], np.rint(self.at[:, 2])))
        return [(int(k), from_top[self.octave[from_top] == k]) for k in np.unique(self.octave)]


def find_keypoints(grey: UInt8[np.ndarray, "h w"], contrast_threshold: float, edge_threshold: float) -> Keypoints:
    """Keypoints of a photo, by octave, level and place.

    Args:
        contrast_threshold, edge_threshold: See `SiftOptions`.

    Source:
        `lowe2004`, section 3.3: the photo is enlarged twice, linearly.
    """
    weights, radii = octave_weights()
    least_contrast = np.float32(contrast_threshold * GREY_LEVELS / LAYERS)
    size = ENLARGED * grey.shape[1], ENLARGED * grey.shape[0]
    enlarged = cv2.resize(grey.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    blur = float(np.sqrt(SIGMA**2 - (ENLARGED * PHOTO_SIGMA) ** 2))
    first = blurred_numba(np.asarray(enlarged, dtype=np.float32), gaussian_weights(blur))
    octaves: list[Octave] = []
    extrema = [np.empty((0, 4))]
    while min(first.shape) > 2 * BORDER:
        levels = empty_levels(first)
        found = octave_extrema_numba(levels, weights, radii, least_contrast, edge_threshold)
        # Those that several pixels lead to are the same to the last bit.
        extrema.append(np.unique(found[:, [2, 1, 0, 3]], axis=0)[:, [2, 1, 0, 3]])
        octaves.append(levels[1 : LAYERS + 1])
        first = np.ascontiguousarray(levels[LAYERS][::2, ::2])
    return Keypoints(
        tuple(octaves),
        np.repeat(np.arange(len(extrema)) - 1, [len(found) for found in extrema]),
        np.concatenate(extrema),
    )
