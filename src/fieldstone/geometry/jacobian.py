"""Pixels of points in the world, and their derivatives by the pose, the points and the camera's parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera, image_from_cam_jacobian
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import skew


@dataclass(frozen=True, eq=False)
class ImageJacobian:
    """Pixels, and their derivatives by the tangent (omega, v) of `Rigid3.retract`, the point and the parameters."""

    pixels: Float[np.ndarray, "n 2"]
    by_pose: Float[np.ndarray, "n 2 6"]
    by_point: Float[np.ndarray, "n 2 3"]
    by_params: Float[np.ndarray, "n 2 p"]


def image_from_world_jacobian(
    camera: Camera, cam_from_world: Rigid3, points_in_world: Float[np.ndarray, "n 3"]
) -> ImageJacobian:
    """Project points of the world and differentiate; nan behind the camera.

    With x = R X + t and the right update (R exp(omega), t + R v): dx/domega = -R [X]_x, dx/dv = dx/dX = R.

    Args:
        cam_from_world: One pose, or one per point.

    Source:
        `triggs2000`, section 4; `chirikjian2011`, section 10.6, for the derivative of exp.
    """
    pixels, by_cam_point, by_params = image_from_cam_jacobian(camera, cam_from_world.apply(points_in_world))
    by_point = by_cam_point @ cam_from_world.R
    by_pose = np.concatenate([-by_point @ skew(points_in_world), by_point], axis=2)
    return ImageJacobian(pixels, by_pose, by_point, by_params)
