"""A projective space for photos that look the same way: near things get small cells, and infinity has a place.

With x, y, z in the axes of a mean camera, a point goes to

    (x / z,  y / z,  depth (1 - near / z)),

so that z from `near` to infinity fills a box. Projective maps keep straight lines straight: a ray becomes a segment
from the plane z = near to the one at infinity, and is marched like any other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.geometry.camera import bearings_from_image
from fieldstone.scene.photos import PosedPhotos

MAX_ANGLE_DEG = 65.0
"""No pixel may look further away from the mean axis."""

NEAR_FRACTION = 0.9
"""The near plane lies at this share of the depth of the nearest points (1st percentile)."""

DEPTH_RATIO = 0.4
"""Depth of the box over its longest side: cells along the rays may be longer than they are wide."""

MARGIN = 1.02


class Projection(NamedTuple):
    """The space, relative to normalised coordinates."""

    R: np.ndarray
    """float32 (3, 3): mean camera axes from normalised axes."""
    center: np.ndarray
    """float32 (3): centre of the mean camera."""
    near: np.float32
    depth: np.float32


def no_projection() -> Projection:
    """What stands in for a projection where there is none."""
    return Projection(np.eye(3, dtype=np.float32), np.zeros(3, np.float32), np.float32(1), np.float32(1))


def projection_for(
    photos: PosedPhotos, frame: FieldFrame, points_in_world: Float[np.ndarray, "p 3"]
) -> tuple[Projection, Float[np.ndarray, "2 3"]] | None:
    """The projective space of photos that look the same way, and the box of their rays; None if they do not.

    They do when every ray is within `MAX_ANGLE_DEG` of the mean axis and all cameras stand before the near plane.
    """
    world = frame.normalized_from_world
    poses = [photos.pose_of(v) for v in range(len(photos))]
    axis = np.mean([world.R @ pose.R[2] for pose in poses], axis=0)
    right = np.mean([world.R @ pose.R[0] for pose in poses], axis=0)
    if np.linalg.norm(axis) < 0.5 or np.linalg.norm(right) < 0.5 or not len(points_in_world):
        return None
    axis /= np.linalg.norm(axis)
    right -= (right @ axis) * axis
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(axis, right), axis])
    centers = np.stack([world.apply(pose.target_origin_in_source()) for pose in poses])
    center = centers.mean(axis=0)
    depths = (world.apply(points_in_world) - center) @ axis
    near = NEAR_FRACTION * float(np.percentile(depths[depths > 0], 1)) if np.any(depths > 0) else 0.0
    if near <= float(((centers - center) @ axis).max()) + 1e-6:
        return None
    corners = []
    for v, camera_center in enumerate(centers):
        camera = photos.camera_of(v)
        w, h = camera.width, camera.height
        border = np.array([[x, y] for x in (0.5, w / 2, w - 0.5) for y in (0.5, h / 2, h - 0.5)])
        directions = bearings_from_image(camera, border) @ poses[v].R @ world.R.T
        directions = directions[np.all(np.isfinite(directions), axis=1)]
        if np.any(directions @ axis < np.cos(np.deg2rad(MAX_ANGLE_DEG))):
            return None
        local, o = directions @ R.T, R @ (camera_center - center)
        at_near = o + (near - o[2]) / local[:, 2:] * local
        corners += [at_near[:, :2] / near, local[:, :2] / local[:, 2:]]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    middle, half = (low + high) / 2, MARGIN * (high - low) / 2
    depth = DEPTH_RATIO * float(2 * half.max())
    bounds = np.array([[*(middle - half), 0.0], [*(middle + half), depth]])
    projection = Projection(R.astype(np.float32), center.astype(np.float32), np.float32(near), np.float32(depth))
    return projection, bounds


def project_points(projection: Projection, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points with z > 0 in the axes of the mean camera."""
    x, y, z = ((points - projection.center) @ projection.R.T.astype(np.float64)).T
    return np.stack([x / z, y / z, projection.depth * (1.0 - projection.near / z)], axis=1)


def unproject_points(projection: Projection, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The inverse of `project_points`, for points before infinity."""
    z = projection.near / (1.0 - points[:, 2] / float(projection.depth))
    local = np.stack([points[:, 0] * z, points[:, 1] * z, z], axis=1)
    return local @ projection.R.astype(np.float64) + projection.center


def project_rays(
    projection: Projection, origins: Float[np.ndarray, "r 3"], directions: Float[np.ndarray, "r 3"]
) -> tuple[Float[np.ndarray, "r 3"], Float[np.ndarray, "r 3"], Float[np.ndarray, "r"]]:
    """Where projected rays begin, their unit directions, and their lengths to infinity.

    A ray that does not look ahead gets the length 0 and points out of the box.
    """
    R = projection.R.astype(np.float64)
    o, d = (origins - projection.center) @ R.T, directions @ R.T
    ahead = d[:, 2] > 1e-3
    dz = np.where(ahead, d[:, 2], 1.0)[:, None]
    start = (o + (projection.near - o[:, 2:]) / dz * d)[:, :2] / projection.near
    end = d[:, :2] / dz
    segment = np.column_stack([end - start, np.full(len(o), float(projection.depth))])
    length = np.linalg.norm(segment, axis=1)
    segment = np.where(ahead[:, None], segment / length[:, None], [0.0, 0.0, -1.0])
    return np.column_stack([start, np.zeros(len(o))]), segment, np.where(ahead, length, 0.0)


def distance_along(
    projection: Projection,
    origins: Float[np.ndarray, "r 3"],
    directions: Float[np.ndarray, "r 3"],
    fraction: Float[np.ndarray, "r"],
) -> Float[np.ndarray, "r"]:
    """Distance from the origin of a ray, before projection, of the point at a fraction in [0, 1) of its segment."""
    axis = projection.R[2].astype(np.float64)
    z = projection.near / np.maximum(1.0 - fraction, 1e-6)
    return (z - (origins - projection.center) @ axis) / np.maximum(directions @ axis, 1e-3)
