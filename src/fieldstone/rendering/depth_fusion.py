"""Rendered depths of many views to one surface: what photos learn is where light ends, not how dense matter is."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3

REACH = 3
"""Steps of the grid on both sides of a surface within which depths say where it lies."""

Position = Callable[[Int[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


def fused(
    solid_fraction: Float[np.ndarray, "x y z"],
    level: float,
    position: Position,
    views: Iterable[tuple[Camera, Rigid3, Float[np.ndarray, "h w"]]],
) -> Float[np.ndarray, "x y z"]:
    """The grid with 1 inside of what is solid, 0 outside, and 0.5 on the surface that the views show.

    Near the surface of the given grid, each view tells the signed distance of a grid point to what it sees in this
    direction, cut off at `REACH` steps; the mean of all counts. What lies further behind is hidden, and says nothing;
    where no view says anything, the given grid stays.

    Args:
        solid_fraction: What is at least `level` is solid.
        position: Of points of the grid in the world, from their indices.
        views: Camera, `cam_from_world` and depths along the rays; infinite where a view looks through.

    Source:
        `curless1996`, section 3, with equal weights.
    """
    solid = solid_fraction >= level
    inner = ndimage.binary_erosion(solid, iterations=REACH, border_value=1)
    index = np.argwhere(ndimage.binary_dilation(solid, iterations=REACH) > inner)
    points = position(index)
    steps = [np.linalg.norm(position(index + one) - points, axis=1) for one in np.eye(3, dtype=np.int64)]
    reach: Float[np.ndarray, "n"] = REACH * np.max(steps, axis=0)
    total, count = np.zeros(len(points)), np.zeros(len(points), dtype=np.int64)
    for camera, pose, depth in views:
        in_cam = pose.apply(points)
        pixels = image_from_cam(camera, in_cam)
        inside = (in_cam[:, 2] > 0) & np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
        rows = np.flatnonzero(inside)
        column, row = pixels[rows].astype(np.int64).T
        ahead = (depth[row, column] - np.linalg.norm(in_cam[rows], axis=1)) / reach[rows]
        rows, ahead = rows[ahead > -1.0], ahead[ahead > -1.0]
        total[rows] += np.minimum(ahead, 1.0)
        count[rows] += 1
    out = solid.astype(np.float32)
    observed = count > 0
    out[tuple(index[observed].T)] = 0.5 - 0.5 * total[observed] / count[observed]
    return out
