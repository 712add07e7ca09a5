"""What a lens does to the angles of a photo: how far it sees, and whether its pixels lead back to one ray each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera

LARGEST_ANGLE = np.deg2rad(89.0)
"""Of a ray with the axis; cameras see nothing on or behind the plane z = 0."""
NUM_ANGLES = 500


def border_radii(camera: Camera) -> tuple[Float[np.ndarray, "8 2"], Float[np.ndarray, "8"]]:
    """Directions from the principal point to corners and middles of the sides, and their distances over the focal
    lengths."""
    w, h = camera.width, camera.height
    border = np.array([[0, 0], [w / 2, 0], [w, 0], [w, h / 2], [w, h], [w / 2, h], [0, h], [0, h / 2]])
    offsets = (border - camera.principal_point) / camera.focal
    radii = np.linalg.norm(offsets, axis=1)
    return offsets / np.maximum(radii, 1e-12)[:, None], radii


def corner_radius(camera: Camera) -> float:
    """Half the diagonal of the photo over the focal length: the tangent of its angle, were the lens perspective."""
    return float(np.hypot(*(np.array([camera.width, camera.height]) / 2 / camera.focal)))


def border_angles(camera: Camera, *, beyond: float = 1.0) -> tuple[Float[np.ndarray, "8"], Float[np.ndarray, "8"]]:
    """Angles with the axis at which rays reach the border of the photo, and the radii there over the focal length.

    The radius g(theta) along each direction is followed outwards from the axis for as long as it grows.

    Args:
        beyond: So many times the distance of the border is to be reached.

    Returns:
        nan where the radius stops growing before the border; 89 degrees where it has not reached it until there: such
        rays are beyond what cameras of a plane see.
    """
    directions, radii = border_radii(camera)
    theta = np.linspace(0.0, LARGEST_ANGLE, NUM_ANGLES + 1)
    angles = np.empty(len(radii))
    for k, (direction, radius) in enumerate(zip(directions, beyond * radii, strict=True)):
        distorted, _, _ = camera.spec.distort(np.tan(theta)[:, None] * direction, camera.coefficients)
        g = distorted @ direction
        grows = np.diff(g) > 0.0
        last = NUM_ANGLES if grows.all() else int(np.argmin(grows))
        known = grows.all() or g[last] >= radius
        angles[k] = np.interp(radius, g[: last + 1], theta[: last + 1]) if known else np.nan
    return angles, beyond * radii


def is_invertible(camera: Camera, *, beyond: float = 1.1) -> bool:
    """Whether one angle only reaches every pixel of the photo, and those beyond its border up to so many times its
    distance."""
    return bool(np.all(np.isfinite(border_angles(camera, beyond=beyond)[0])))


def sees_like_a_fisheye(camera: Camera, min_angle_deg: float = 50.0) -> bool:
    """Whether the corners are at angles that call for a fisheye lens, and at radii of one.

    Fisheye lenses follow r = f theta, 2 f sin(theta / 2) and the like, at most 2 f tan(theta / 2); a perspective lens
    r = f tan(theta). The border between the two is their geometric mean.
    """
    angles, radii = border_angles(camera)
    corner = int(np.nanargmax(np.where(np.isfinite(angles), radii, -1.0)))
    theta = angles[corner]
    if not np.isfinite(theta) or theta < np.deg2rad(min_angle_deg):
        return False
    return bool(radii[corner] < np.sqrt(2.0 * np.tan(theta / 2.0) * np.tan(theta)))
