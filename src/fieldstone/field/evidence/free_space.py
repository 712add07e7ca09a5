"""Space that the photos look through: what lies well in front of the nearest known points of a photo is empty.

Without it, a field explains the photos best by a coloured cloud right in front of each camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import numpy as np
from jaxtyping import Float, Shaped
from scipy.spatial import KDTree

from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import SeenPoints
from fieldstone.field.base.space import Space, normalized_from_grid
from fieldstone.field.evidence.options import DEFAULT_EVIDENCE, FreeSpaceOptions
from fieldstone.field.grid.occupancy import Occupancy
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.photos import PosedPhotos
from fieldstone.scene.rays import pixel_centers

FARTHEST = 1e4
"""What is further away, in units of the frame, is at infinity."""


def carve_free_space(
    occupancy: Occupancy,
    photos: PosedPhotos,
    frame: FieldFrame,
    seen: Sequence[SeenPoints | None],
    space: Space,
    executor: Executor,
    options: FreeSpaceOptions = DEFAULT_EVIDENCE.free_space,
) -> Occupancy:
    """The occupancy without cells that photos look through.

    A cell is empty if all its corners lie in front of the known points around them in one photo, or if it is nearer
    to a photo than most of its points are and too few photos see it: nothing but this photo would say what is there,
    and anything it shows could be put there. Around a camera, that holds for the cells that no photo sees as well: no
    photo would ever correct what the coarse grids spread into them, and a new view may look through them.

    Args:
        seen: Of each photo, in the world.
    """
    corners = corners_in_world(occupancy, frame, space)
    positions, shape = corners.reshape(-1, 3), corners.shape[:3]

    def of_photo(v: int) -> tuple[np.ndarray, ...]:
        """Cells that are free, that the photo sees, that it sees from near, that it sees a part of, and around it."""
        camera, pose, points = photos.camera_of(v), photos.pose_of(v), seen[v]
        away = np.linalg.norm(positions - pose.target_origin_in_source(), axis=1)
        pixels = image_from_cam(camera, pose.apply(positions))
        # nan, behind the camera, is not inside.
        inside = np.all((pixels >= 0) & (pixels <= [camera.width, camera.height]), axis=1)
        free, near, around = np.zeros((3, len(positions)), dtype=bool)
        if points is not None and len(points.xyz) >= options.min_points:
            distances = np.linalg.norm(points.xyz - pose.target_origin_in_source(), axis=1)
            least = least_distance(camera, pose, points.xyz, distances, pixels[inside], options)
            free[inside] = away[inside] < options.free_fraction * least
            near = inside & (away < np.percentile(distances, options.near_percent))
            around = away < options.free_fraction * np.percentile(distances, options.around_percent)
        # A photo may see a part of a cell, but none of its corners.
        spans = [[of_corners(pixels[:, axis], combine) for combine in (np.fmin, np.fmax)] for axis in (0, 1)]
        (left, right), (top, bottom) = spans
        part = (right >= 0) & (left <= camera.width) & (bottom >= 0) & (top <= camera.height)
        some = [of_corners(flags, np.logical_or) for flags in (inside, near)]
        return of_corners(free, np.logical_and), *some, part, of_corners(around, np.logical_and)

    def of_corners(values: np.ndarray, combine: np.ufunc) -> np.ndarray:
        return _of_corners(values.reshape(shape), combine)

    cells = occupancy.cells.copy()
    times_seen = np.zeros(cells.shape, dtype=np.int32)
    near_some, parts_seen, around_some = np.zeros((3, *cells.shape), dtype=bool)
    for free, visible, near, part, around in executor.map(of_photo, range(len(photos))):
        cells &= ~free
        times_seen += visible
        near_some |= near
        parts_seen |= part
        around_some |= around
    cells &= ~(near_some & (times_seen < (options.min_views if len(photos) >= options.many_photos else 2)))
    cells &= ~around_some | parts_seen
    return Occupancy(occupancy.lower, occupancy.cell_size, cells)


def free_distances(
    photos: PosedPhotos,
    frame: FieldFrame,
    seen: Sequence[SeenPoints | None],
    options: FreeSpaceOptions = DEFAULT_EVIDENCE.free_space,
) -> Callable[[int], Float[np.ndarray, "p"]]:
    """How far every pixel of photo v probably sees, in the frame; 0 where too little is known.

    Unlike in `carve_free_space`, something may stand there: the distance is nearly that of the points around it.
    """

    def of_photo(v: int) -> Float[np.ndarray, "p"]:
        camera, pose, points = photos.camera_of(v), photos.pose_of(v), seen[v]
        if points is None or len(points.xyz) < options.min_points:
            return np.zeros(camera.width * camera.height, dtype=np.float32)
        distances = np.linalg.norm(points.xyz - pose.target_origin_in_source(), axis=1)
        least = least_distance(camera, pose, points.xyz, distances, pixel_centers(camera.width, camera.height), options)
        return (options.free_loss_fraction * frame.normalized_from_world.scale * least).astype(np.float32)

    return of_photo


def least_distance(
    camera: Camera,
    cam_from_world: Rigid3,
    points: Float[np.ndarray, "p 3"],
    distances: Float[np.ndarray, "p"],
    pixels: Float[np.ndarray, "n 2"],
    options: FreeSpaceOptions = DEFAULT_EVIDENCE.free_space,
) -> Float[np.ndarray, "n"]:
    """Of the points that are nearest to each pixel in the photo (`neighbours` of them), how far the nearest one is.

    Args:
        points: In the world; distances: from the camera.
    """
    size = np.array([camera.width, camera.height])
    block = size.max() / options.blocks
    centers = np.stack(np.meshgrid(*(np.arange(np.ceil(n / block)) for n in size), indexing="ij"), axis=-1)
    tree = KDTree(image_from_cam(camera, cam_from_world.apply(points)))
    _, nearest = tree.query((centers.reshape(-1, 2) + 0.5) * block, k=options.neighbours)
    least = distances[nearest].min(axis=1).reshape(centers.shape[:2])
    i, j = np.minimum((pixels / block).astype(np.int64), np.array(least.shape) - 1).T
    return least[i, j]


def corners_in_world(occupancy: Occupancy, frame: FieldFrame, space: Space) -> Float[np.ndarray, "x y z 3"]:
    """Corners of the cells in the world; nan where they lie at infinity."""
    shape = tuple(n + 1 for n in occupancy.cells.shape)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    points = occupancy.lower + index * occupancy.cell_size
    points = normalized_from_grid(space, points)
    finite = np.abs(points).max(axis=1, keepdims=True) <= FARTHEST  # False for nan too
    points = np.where(finite, points, np.nan)
    return frame.normalized_from_world.inverse().apply(points).reshape(*shape, 3)


def _of_corners(values: Shaped[np.ndarray, "x1 y1 z1"], combine: np.ufunc) -> Shaped[np.ndarray, "x y z"]:
    """Values at the eight corners of each cell, combined."""
    for axis in range(3):
        low, high = (np.take(values, range(first, values.shape[axis] - 1 + first), axis) for first in (0, 1))
        values = combine(low, high)
    return values
