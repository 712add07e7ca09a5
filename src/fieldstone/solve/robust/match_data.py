"""Matches of two photos as the arrays that the compiled estimators read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, plane_from_image


@dataclass(frozen=True, eq=False)
class MatchData:
    """Usable matches in random order, on the ideal planes of both cameras.

    columns: x1, y1, x2, y2 and the squared size of a pixel of each photo at the match (`epipolar_numba`).
    rows: The match that each column holds.
    """

    columns: Float[np.ndarray, "6 n"]
    rows: Int[np.ndarray, "n"]
    num_matches: int

    def mask(self, chosen: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "m"]:
        """Chosen columns as a mask over all matches."""
        out = np.zeros(self.num_matches, dtype=bool)
        out[self.rows[chosen]] = True
        return out

    def as_transfer(self, columns: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "8 c"]:
        """Some columns as observations x2, y2 of points (x1, y1, 1), for a homography (`reprojection_numba`)."""
        x1, y1, x2, y2, _, v2 = self.columns[:, columns]
        focal = 1.0 / np.sqrt(v2)
        return np.stack([x2, y2, x1, y1, np.ones_like(x1), focal, np.zeros_like(x1), focal])


def match_data(
    camera1: Camera,
    camera2: Camera,
    pixels1: Float[np.ndarray, "m 2"],
    pixels2: Float[np.ndarray, "m 2"],
    rng: np.random.Generator,
    pixel_scales: tuple[float, float] = (1.0, 1.0),
) -> MatchData:
    """Matches whose pixels are finite and lie in the range of the lens models, in random order.

    Args:
        pixel_scales: How many pixels of each photo count as one in its errors.
    """
    uv1, uv2 = plane_from_image(camera1, pixels1), plane_from_image(camera2, pixels2)
    usable = np.flatnonzero(np.isfinite(uv1).all(axis=1) & np.isfinite(uv2).all(axis=1))
    rows = usable[rng.permutation(len(usable))]
    columns = np.empty((6, len(rows)))
    columns[:2], columns[2:4] = uv1[rows].T, uv2[rows].T
    columns[4] = pixel_size_squared(camera1, columns[:2].T) * pixel_scales[0] ** 2
    columns[5] = pixel_size_squared(camera2, columns[2:4].T) * pixel_scales[1] ** 2
    return MatchData(columns, rows, len(pixels1))


def pixel_size_squared(camera: Camera, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"] | float:
    """Area of one pixel on the plane z = 1 at each coordinate: 1 / |det J|, J the derivative of the pixel."""
    if not camera.spec.coefficient_names:
        return 1.0 / float(camera.focal.prod())
    _, D_uv, _ = camera.spec.distort(uv, camera.coefficients)
    det = D_uv[:, 0, 0] * D_uv[:, 1, 1] - D_uv[:, 0, 1] * D_uv[:, 1, 0]
    return 1.0 / (np.abs(det) * camera.focal.prod())
