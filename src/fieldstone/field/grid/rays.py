"""All training pixels whose rays can meet something, as one flat table that the kernels draw from."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import poses_in_frame
from fieldstone.field.grid.march_numba import Box
from fieldstone.field.grid.occupancy_numba import rays_that_hit
from fieldstone.geometry.camera import bearings_from_image
from fieldstone.scene.photos import DecodedPhotos, PosedPhotos
from fieldstone.scene.rays import pixel_centers

GOLDEN_RATIO = 0.6180339887498949


class RayTable(NamedTuple):
    """Row n: the ray from centers[image[n]] along rotations[image[n]] bearings[bearing[n]], and what it sees.

    Rows are drawn in the order n_i = i stride mod rows: the stride is near the golden ratio of the number of rows and
    prime to it, so that any run of draws is spread evenly over photos and pixels, and each row comes once a round.
    """

    image: np.ndarray
    bearing: np.ndarray
    rgba: np.ndarray
    """uint8 (n, 4), straight alpha."""
    bearings: np.ndarray
    rotations: np.ndarray
    """float32 (v, 3, 3): box axes from camera axes."""
    centers: np.ndarray
    free_distance: np.ndarray
    """float32 (n): the ray probably meets nothing before this distance; 0 where nothing is known."""
    stride: int


def ray_table(
    photos: DecodedPhotos,
    frame: FieldFrame,
    box: Box,
    executor: Executor,
    *,
    use_alpha: bool = True,
    free_distance_of: Callable[[int], Float[np.ndarray, "p"]] | None = None,
) -> RayTable:
    """The table of all pixels whose rays meet an occupied cell, and some beside them (all, in an open space).

    Args:
        use_alpha: False composites the photos on the background of the frame and forgets their alpha.
        free_distance_of: How far every pixel of photo v probably sees, see `RayTable.free_distance`.

    Raises:
        InputError: No ray meets the box.
    """
    posed = photos.posed
    first_bearing, bearings = _bearings(posed)
    rotations, centers = poses_in_frame(posed.cam_from_world, frame)

    def rows_of(v: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        camera, keep = posed.camera_of(v), photos.keep[v]
        first = first_bearing[posed.camera_of_photo[v]]
        in_cam = bearings[first : first + camera.width * camera.height]
        reached = np.isfinite(in_cam[:, 0])
        if keep is not None:
            reached &= keep.reshape(-1)
        if not box.space.is_open:
            by_row = in_cam.reshape(camera.height, camera.width, 3)
            reached &= pixels_that_hit(box, centers[v], rotations[v], by_row, float(np.mean(camera.focal))).reshape(-1)
        rows = np.flatnonzero(reached)
        whole_pixels = _rgba(photos, v, frame, use_alpha).view(np.uint32)  # one number each is faster to take
        free_distance = np.zeros(len(rows), np.float32) if free_distance_of is None else free_distance_of(v)[rows]
        return (rows + first).astype(np.int32), whole_pixels[rows].view(np.uint8), free_distance

    parts = list(executor.map(rows_of, range(len(photos))))
    counts = [len(rows) for rows, _, _ in parts]
    total = sum(counts)
    if total == 0:
        raise InputError(
            "no training ray meets the scene: no photo looks at where the others see something; check the poses "
            "and, if there are masks, that the scene is white in them"
        )
    return RayTable(
        image=np.repeat(np.arange(len(photos), dtype=np.int32), counts),
        bearing=np.concatenate([rows for rows, _, _ in parts]),
        rgba=np.concatenate([rgba for _, rgba, _ in parts]),
        bearings=bearings,
        rotations=rotations,
        centers=centers,
        free_distance=np.concatenate([free_distance for _, _, free_distance in parts]),
        stride=coprime_stride(total),
    )


def pixels_that_hit(
    box: Box,
    center: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    bearings: Float[np.ndarray, "h w 3"],
    focal: float,
) -> Bool[np.ndarray, "h w"]:
    """At least the pixels whose rays meet an occupied cell of a bounded box.

    Of a square block of pixels, only the ray in the middle is walked, through cells that have grown by one on all
    sides: a block is at most as wide as a cell is at the far end of the box, so no ray of it strays further.

    Args:
        center: Of the camera, in the frame of the box.
        rotation: Box axes from camera axes.
    """
    corners = box.lower + box.extent * np.array(list(np.ndindex(2, 2, 2)), dtype=np.float32)
    farthest = float(np.linalg.norm(corners - center, axis=1).max())
    block = max(int(np.sqrt(2.0) * float(box.cell_size) * focal / farthest), 1)
    if block > 1:
        box = box._replace(distance=np.maximum(box.distance, 1) - np.uint8(1))
    height, width = bearings.shape[:2]
    y, x = (np.minimum(np.arange(0, size, block) + block // 2, size - 1) for size in (height, width))
    middle = bearings[y[:, None], x]
    hit = np.zeros(len(y) * len(x), dtype=np.uint8)
    rays_that_hit(box, center, np.ascontiguousarray(middle.reshape(-1, 3) @ rotation.T), hit)
    hit[~np.isfinite(middle.reshape(-1, 3)[:, 0])] = 1
    blocks = hit.reshape(len(y), len(x)).astype(bool)
    return np.repeat(np.repeat(blocks, block, axis=0), block, axis=1)[:height, :width]


def coprime_stride(count: int) -> int:
    """The number nearest above count times the golden ratio that has no divisor in common with count."""
    stride = max(int(count * GOLDEN_RATIO), 1)
    while np.gcd(stride, count) != 1:
        stride += 1
    return stride


def _bearings(posed: PosedPhotos) -> tuple[Int[np.ndarray, "c"], Float[np.ndarray, "k 3"]]:
    """Where each camera's bearings start, and the bearings of every pixel of every camera."""
    parts = [
        bearings_from_image(camera, pixel_centers(camera.width, camera.height)).astype(np.float32)
        for camera in posed.cameras
    ]
    return np.cumsum([0, *map(len, parts[:-1])], dtype=np.int32), np.concatenate(parts)


def _rgba(photos: DecodedPhotos, v: int, frame: FieldFrame, use_alpha: bool) -> UInt8[np.ndarray, "p 4"]:
    pixels = photos.pixels[v]
    height, width, channels = pixels.shape
    rgba = np.full((height * width, 4), 255, dtype=np.uint8)
    if use_alpha or channels == 3:
        rgba[:, :channels] = pixels.reshape(len(rgba), -1)
    else:
        composited = photos.composited(v, frame.background)
        rgba[:, :3] = np.rint(255.0 * composited).astype(np.uint8).reshape(-1, 3)
    return rgba
