"""Triangulated points as what photos are known to see: where, and how certain it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import SeenPoints, poses_in_frame
from fieldstone.field.base.space import Space, along_rays
from fieldstone.field.grid.rays import RayTable, coprime_stride
from fieldstone.field.grid.terms_numba import SparseDepths
from fieldstone.geometry.camera import image_from_cam
from fieldstone.scene.photos import DecodedPhotos
from fieldstone.scene.reconstruction import Reconstruction

MIN_SIGMA_PX = 0.5
"""Observations are not trusted to be better than this."""

MAX_SIGMA = 0.1
"""Points whose distance is uncertain by more than this share are left out."""


def seen_points(model: Reconstruction, views: Sequence[int]) -> tuple[SeenPoints, ...]:
    """The points that each of these views of a model observes, with the standard deviations of their distances.

    Every observation of a point along direction d (unit) at distance D, with a focal length of f pixels, says
    (f / (sigma D))^2 (I - d d^T) of it; sigma is the reprojection error of the point (RMS), at least `MIN_SIGMA_PX`.
    The sum over its observations is inverted: narrow angles between rays leave the distance open.
    """
    observed, registered = model.observations, model.registered()
    centers = np.zeros((len(model.views), 3))
    centers[registered] = model.camera_centers()
    focal = np.ones(len(model.views))
    focal[registered] = [float(np.mean(model.camera_of(v).focal)) for v in registered.tolist()]
    errors = model.reprojection_errors()
    usable = np.isfinite(errors)
    view, point = observed.view[usable], observed.point[usable]
    offset = model.points.xyz[point] - centers[view]
    distance = np.linalg.norm(offset, axis=1)
    d = offset / distance[:, None]
    num_points = len(model.points)
    count = np.bincount(point, minlength=num_points)
    mean_square = np.bincount(point, errors[usable] ** 2, minlength=num_points) / np.maximum(count, 1)
    sigma_px = np.maximum(np.sqrt(mean_square), MIN_SIGMA_PX)
    weight = (focal[view] / (sigma_px[point] * distance)) ** 2
    information = np.zeros((num_points, 3, 3))
    np.add.at(information, point, weight[:, None, None] * (np.eye(3) - d[:, :, None] * d[:, None, :]))
    # Where two rays coincide the inverse does not exist; a little of the trace makes the distance uncertain instead.
    trace = np.trace(information, axis1=1, axis2=2)
    information += np.where(trace > 0, 1e-9 * trace, 1.0)[:, None, None] * np.eye(3)
    covariance = np.linalg.inv(information)
    sigma = np.sqrt(np.einsum("oi,oij,oj->o", d, covariance[point], d))
    good = (count[point] >= 2) & (sigma < MAX_SIGMA * distance)
    rows_of = [good & (view == v) for v in views]
    return tuple(SeenPoints(model.points.xyz[point[rows]], sigma[rows]) for rows in rows_of)


def no_sparse_depth_rays() -> tuple[RayTable, SparseDepths]:
    """No such rays."""
    empty = np.zeros((0, 3), dtype=np.float32)
    table = RayTable(
        image=np.zeros(0, np.int32),
        bearing=np.zeros(0, np.int32),
        rgba=np.zeros((0, 4), np.uint8),
        bearings=empty,
        rotations=np.zeros((0, 3, 3), np.float32),
        centers=empty,
        free_distance=empty[:, 0].copy(),
        stride=1,
    )
    return table, SparseDepths(empty[:, 0].copy(), empty[:, 0].copy(), empty[:, 0].copy())


def sparse_depth_rays(
    photos: DecodedPhotos,
    frame: FieldFrame,
    seen: Sequence[SeenPoints | None],
    space: Space,
) -> tuple[RayTable, SparseDepths]:
    """Rays from photos to the points that they see, the colours there, and how far along each ray its point lies.

    Args:
        seen: Of each photo, in the world.
    """
    rotations, centers = poses_in_frame(photos.posed.cam_from_world, frame)
    world = frame.normalized_from_world
    parts = []
    for v, points in enumerate(seen):
        if points is None or not len(points.xyz):
            continue
        camera, keep = photos.posed.camera_of(v), photos.keep[v]
        in_cam = photos.posed.pose_of(v).apply(points.xyz)
        pixels = image_from_cam(camera, in_cam)
        inside = np.all((pixels >= 0.5) & (pixels <= [camera.width - 0.5, camera.height - 0.5]), axis=1)
        rows = np.flatnonzero(inside)
        if keep is not None:
            column, row = pixels[rows].astype(np.int64).T
            rows = rows[keep[row, column]]
        rgba = _colors(photos.pixels[v], pixels[rows])
        rows, rgba = rows[rgba[:, 3] > 127], rgba[rgba[:, 3] > 127]
        xyz, sigma = world.apply(points.xyz[rows]), world.scale * points.sigma[rows]
        along = np.stack(along_rays(space, centers[v], xyz, sigma))
        good = np.isfinite(along[0])
        bearings = in_cam[rows] / np.linalg.norm(in_cam[rows], axis=1, keepdims=True)
        parts.append((np.full(len(rows), v)[good], bearings[good], rgba[good], along[:, good]))
    if not sum(len(part[0]) for part in parts):
        return no_sparse_depth_rays()
    image, bearings, rgba = (np.concatenate([part[k] for part in parts]) for k in range(3))
    along = np.concatenate([part[3] for part in parts], axis=1).astype(np.float32)
    rows = np.arange(len(image), dtype=np.int32)
    table = RayTable(
        image=image.astype(np.int32),
        bearing=rows,
        rgba=rgba,
        bearings=bearings.astype(np.float32),
        rotations=rotations,
        centers=centers,
        free_distance=np.zeros(len(image), dtype=np.float32),
        stride=coprime_stride(len(image)),
    )
    return table, SparseDepths(*along)


def _colors(pixels: np.ndarray, at_px: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """RGBA between pixel centres, bilinear."""
    height, width, channels = pixels.shape
    x, y = at_px[:, 0] - 0.5, at_px[:, 1] - 0.5
    i, j = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    u, w = (x - i)[:, None], (y - j)[:, None]
    upper = (1 - u) * pixels[j, i] + u * pixels[j, i + 1]
    lower = (1 - u) * pixels[j + 1, i] + u * pixels[j + 1, i + 1]
    rgba = np.full((len(x), 4), 255, dtype=np.uint8)
    rgba[:, :channels] = np.rint((1 - w) * upper + w * lower)
    return rgba
