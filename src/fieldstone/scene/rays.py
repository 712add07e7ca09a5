"""Viewing rays of a posed camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera, bearings_from_image
from fieldstone.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in the world: x(t) = origin + t direction, |direction| = 1.

    pixel_radius: half the width of the pixel's cone at t = 1, in scene units.
    """

    origins: Float[np.ndarray, "r 3"]
    directions: Float[np.ndarray, "r 3"]
    pixel_radius: Float[np.ndarray, "r"]

    def __len__(self) -> int:
        return len(self.origins)


def pixel_centers(width: int, height: int) -> Float[np.ndarray, "n 2"]:
    """Centres (x + 0.5, y + 0.5) of all pixels, row by row."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)


def _rays_along(bearings: Float[np.ndarray, "r 3"], camera: Camera, cam_from_world: Rigid3) -> Rays:
    directions = bearings @ cam_from_world.R
    origin = cam_from_world.target_origin_in_source()
    # Half a pixel at the focal distance, seen along a ray of length 1 / bearing_z.
    radius = 0.5 * bearings[:, 2] / np.mean(camera.focal)
    return Rays(np.broadcast_to(origin, directions.shape).copy(), directions, radius)


@lru_cache(maxsize=2)
def _pixel_bearings(camera: Camera) -> Float[np.ndarray, "n 3"]:
    """Bearings of all pixels; cameras are compared by identity, as their arrays are never written."""
    bearings = bearings_from_image(camera, pixel_centers(camera.width, camera.height))
    bearings.flags.writeable = False
    return bearings


def rays_from_view(camera: Camera, cam_from_world: Rigid3) -> Rays:
    """The rays through all pixel centres of a view, row by row."""
    return _rays_along(_pixel_bearings(camera), camera, cam_from_world)
