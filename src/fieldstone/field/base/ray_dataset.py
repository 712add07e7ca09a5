"""Posed images as rays and colours, drawn in batches: what every field learns from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import csr_array

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.geometry.camera import bearings_from_image, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.photos import DecodedPhotos, composite_over
from fieldstone.scene.rays import Rays, pixel_centers
from fieldstone.scene.reconstruction import Reconstruction

TEST_EVERY = 8
"""Of photos without a split of their own, every 8th (sorted by name) is held out for testing."""

BLENDER_NEAR, BLENDER_FAR = 2.0, 6.0
"""Range of the rays of the Blender scenes: objects within about 1.5 of the origin, cameras 4 away."""

WHITE = (1.0, 1.0, 1.0)

NORMALIZED_RADIUS = 1.5
"""Where the frame of a reconstruction puts the 90th percentile of its points, as far out as Blender objects reach."""


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points in the world that one photo sees, and the standard deviations of their distances from it."""

    xyz: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class RayDataset:
    """The photos that a field learns from, those held out, and the frame in which it learns.

    Raises:
        InputError: No photo to learn from.
    """

    train: DecodedPhotos
    test: DecodedPhotos
    frame: FieldFrame
    points_in_world: Float[np.ndarray, "p 3"]
    """Triangulated points, none where only images and poses are known."""
    bounded: bool = True
    """Nothing lies beyond the cube of half side `NORMALIZED_RADIUS` around the origin of the frame."""
    seen: tuple[SeenPoints | None, ...] = ()
    """What each photo of `train` is known to see; empty: nothing is known of any."""

    def __post_init__(self) -> None:
        if not len(self.train):
            raise InputError("no photo to train on: all photos were held out or none has a pose")
        if len(self.seen) not in (0, len(self.train)):
            raise ValueError(f"{len(self.train)} photos to train on, but points of {len(self.seen)}")


@dataclass(frozen=True, eq=False)
class TrainingRays:
    """All pixels of the training images as one flat table, cheap to draw from.

    Pixel p belongs to image `image[p]`; its ray starts at `centers[image[p]]` and points along
    `R_world[image[p]] @ bearings[bearing[p]]`. Pixels that no ray of their camera reaches are left out.
    """

    pixels: UInt8[np.ndarray, "p 4"]
    """RGBA with straight alpha; 255 where the photo had none."""
    background: Float[np.ndarray, "3"]
    image: Int[np.ndarray, "p"]
    bearing: Int[np.ndarray, "p"]
    bearings: Float[np.ndarray, "k 3"]
    pixel_radius: Float[np.ndarray, "k"]
    normalized_from_cam: Float[np.ndarray, "v 3 3"]
    centers: Float[np.ndarray, "v 3"]
    first_pixel: Int[np.ndarray, "v_plus_1"]
    """Pixels of image v are the rows first_pixel[v] to first_pixel[v + 1]."""

    def __len__(self) -> int:
        return len(self.image)

    @property
    def num_images(self) -> int:
        """Number of training images."""
        return len(self.centers)

    def batch(self, index: Int[np.ndarray, "r"]) -> tuple[Rays, Float[np.ndarray, "r 3"]]:
        """Rays in normalised coordinates, and their colours in [0, 1] over the background; float32."""
        image = self.image[index]
        bearing = self.bearing[index]
        directions = np.einsum("rij,rj->ri", self.normalized_from_cam[image], self.bearings[bearing])
        return Rays(self.centers[image], directions, self.pixel_radius[bearing]), self.colors(index)

    def whole_image(self, v: int) -> tuple[Rays, Float[np.ndarray, "r 3"]]:
        """All rays of one image, row by row."""
        rows = slice(int(self.first_pixel[v]), int(self.first_pixel[v + 1]))
        bearing = self.bearing[rows]
        directions = self.bearings[bearing] @ self.normalized_from_cam[v].T
        origins = np.broadcast_to(self.centers[v], directions.shape).copy()
        return Rays(origins, directions, self.pixel_radius[bearing]), self.colors(rows)

    def colors(self, index: Int[np.ndarray, "r"] | slice) -> Float[np.ndarray, "r 3"]:
        """Colours in [0, 1] over the background; float32."""
        return composite_over(self.pixels[index], self.background)


def training_rays(photos: DecodedPhotos, frame: FieldFrame) -> TrainingRays:
    """The table of all training pixels. Photos of one camera share its bearings."""
    posed = photos.posed
    sizes = [camera.width * camera.height for camera in posed.cameras]
    first_bearing = [0, *accumulate(sizes)]
    in_cam = [bearings_from_image(camera, pixel_centers(camera.width, camera.height)) for camera in posed.cameras]
    radii = [0.5 * rows[:, 2] / np.mean(camera.focal) for rows, camera in zip(in_cam, posed.cameras, strict=True)]
    pixels, image_rows, bearing_rows = [], [], []
    for v, k in enumerate(posed.camera_of_photo.tolist()):
        bearing_rows.append(np.arange(first_bearing[k], first_bearing[k + 1], dtype=np.int32))
        image_rows.append(np.full(sizes[k], v, dtype=np.int32))
        rgba = np.full((sizes[k], 4), 255, dtype=np.uint8)
        rgba[:, : photos.pixels[v].shape[2]] = photos.pixels[v].reshape(sizes[k], -1)
        pixels.append(rgba)

    all_bearings = np.concatenate(in_cam)
    bearing = np.concatenate(bearing_rows)
    kept = [
        np.ones(p.shape[:2], dtype=bool) if k is None else k for p, k in zip(photos.pixels, photos.keep, strict=True)
    ]
    reached = np.all(np.isfinite(all_bearings), axis=1)[bearing] & np.concatenate([k.reshape(-1) for k in kept])
    image_of = np.concatenate(image_rows)[reached]
    poses, normalized_from_world = posed.cam_from_world, frame.normalized_from_world
    return TrainingRays(
        pixels=np.concatenate(pixels)[reached],
        background=frame.background,
        image=image_of,
        bearing=bearing[reached],
        bearings=np.nan_to_num(all_bearings).astype(np.float32),
        pixel_radius=np.nan_to_num(np.concatenate(radii)).astype(np.float32),
        normalized_from_cam=(normalized_from_world.R @ np.swapaxes(poses.R, 1, 2)).astype(np.float32),
        centers=normalized_from_world.apply(posed.centers()).astype(np.float32),
        first_pixel=np.searchsorted(image_of, np.arange(len(photos) + 1)),
    )


def reduce_photos(photos: DecodedPhotos, max_size: int) -> DecodedPhotos:
    """The same views with their longer sides at most `max_size` pixels, see `reduce_pixels`."""
    posed = photos.posed
    cameras = []
    for camera in posed.cameras:
        width, height = reduced_size(camera.width, camera.height, max_size)
        cameras.append(camera if width == camera.width else rescale(camera, width, height))
    pixels, keep = [], []
    for v in range(len(photos)):
        camera = cameras[int(posed.camera_of_photo[v])]
        small, small_keep = reduce_pixels(photos.pixels[v], photos.keep[v], camera.width, camera.height)
        pixels.append(small)
        keep.append(small_keep)
    return DecodedPhotos(replace(posed, cameras=tuple(cameras)), tuple(pixels), tuple(keep))


def reduced_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Width and height with the longer one at most `max_size`."""
    longer = max(width, height)
    if longer <= max_size:
        return width, height
    return max(1, round(width * max_size / longer)), max(1, round(height * max_size / longer))


def reduce_pixels(
    pixels: UInt8[np.ndarray, "h w c"], keep: Bool[np.ndarray, "h w"] | None, new_width: int, new_height: int
) -> tuple[UInt8[np.ndarray, "new_h new_w c"], Bool[np.ndarray, "new_h new_w"] | None]:
    """A photo and its mask at a smaller size: each new pixel is the mean of the area it covers.

    Colours are weighted by alpha, so that what lies under transparent pixels does not bleed in. A new pixel is kept if
    all that it covers is.
    """
    height, width = pixels.shape[:2]
    if (width, height) == (new_width, new_height):
        return pixels, keep
    # Nearly all weights are 0: sparse, this is ten times as fast.
    rows, columns = csr_array(area_weights(height, new_height)), csr_array(area_weights(width, new_width))

    def mean(values: np.ndarray) -> np.ndarray:
        channels = values.shape[2]
        lines = (rows @ values.reshape(height, -1)).reshape(new_height, width, channels)
        across = np.ascontiguousarray(lines.transpose(1, 0, 2)).reshape(width, -1)
        return (columns @ across).reshape(new_width, new_height, channels).transpose(1, 0, 2)

    rgb = pixels[..., :3].astype(np.float64)
    if pixels.shape[2] == 3:
        small = mean(rgb)
    else:
        alpha = pixels[..., 3:].astype(np.float64)
        mean_alpha = mean(alpha)
        small = np.concatenate([mean(rgb * alpha) / np.maximum(mean_alpha, 1e-9), mean_alpha], axis=2)
    small_keep = None if keep is None else mean(keep[..., None].astype(np.float64))[..., 0] > 1.0 - 1e-6
    return np.rint(np.clip(small, 0.0, 255.0)).astype(np.uint8), small_keep


def area_weights(size: int, new_size: int) -> Float[np.ndarray, "new_size size"]:
    """Row j: the share of each old pixel in new pixel j, which covers [j, j + 1] size / new_size of the old ones."""
    edges = np.arange(new_size + 1) * (size / new_size)
    old = np.arange(size)
    overlap = np.minimum(edges[1:, None], old + 1.0) - np.maximum(edges[:-1, None], old)
    return np.maximum(overlap, 0.0) * (new_size / size)


def split_every(names: list[str], every: int = TEST_EVERY) -> tuple[list[int], list[int]]:
    """Indices for training and for testing: of the names in sorted order, numbers 0, 8, 16, ... are held out.

    A single photo is not held out.
    """
    order = sorted(range(len(names)), key=lambda i: names[i])
    test = order[::every] if len(names) > 1 else []
    return [i for i in order if i not in set(test)], test


def poses_in_frame(
    cam_from_world: Rigid3, frame: FieldFrame
) -> tuple[Float[np.ndarray, "v 3 3"], Float[np.ndarray, "v 3"]]:
    """Frame axes from camera axes, and centres, of a batch of poses; float32."""
    world = frame.normalized_from_world
    rotations = world.R @ np.swapaxes(cam_from_world.R, -1, -2)
    # One by one: a matrix product of all may round otherwise, and runs are told apart by their bytes.
    centers = [world.apply(center) for center in cam_from_world.target_origin_in_source()]
    return rotations.astype(np.float32), np.stack(centers).astype(np.float32)


def blender_frame(near: float = BLENDER_NEAR, far: float = BLENDER_FAR) -> FieldFrame:
    """The frame of the Blender scenes: their own coordinates, on white."""
    return FieldFrame(Sim3(1.0, np.eye(3), np.zeros(3)), near, far, np.array(WHITE))


def frame_from_points(model: Reconstruction, background: Float[np.ndarray, "3"]) -> FieldFrame:
    """Frame and range from the triangulated points and the photos that observe them; see `frame_from_seen`.

    Raises:
        InputError: Fewer than 10 observations of points.
    """
    registered = set(model.registered().tolist())
    rows = np.array([int(v) in registered for v in model.observations.view], dtype=bool)
    if np.count_nonzero(rows) < 10:
        raise InputError(
            f"the range of a field comes from its points, and only {np.count_nonzero(rows)} observations of points "
            "have a camera pose; run `fieldstone reconstruct` on more photos"
        )
    camera_centers = np.full((len(model.views), 3), np.nan)
    camera_centers[model.registered()] = model.camera_centers()
    seen = model.points.xyz[model.observations.point[rows]]
    distances = np.linalg.norm(seen - camera_centers[model.observations.view[rows]], axis=1)
    return frame_from_seen(model.points.xyz, distances, background)


def frame_from_seen(
    points: Float[np.ndarray, "p 3"], distances: Float[np.ndarray, "o"], background: Float[np.ndarray, "3"]
) -> FieldFrame:
    """Frame and range from points in the world, and the distances at which photos see them.

    The median point is moved to the origin and the scale is chosen so that 90 % of the points lie within 1.5. Rays
    run from 0.8 times the 1st percentile to 1.25 times the 99th percentile of the distances: percentiles, because a
    single bad point must not stretch the range.
    """
    center = np.median(points, axis=0)
    spread = np.percentile(np.linalg.norm(points - center, axis=1), 90)
    scale = NORMALIZED_RADIUS / max(float(spread), 1e-12)
    near, far = 0.8 * scale * np.percentile(distances, 1), 1.25 * scale * np.percentile(distances, 99)
    return FieldFrame(Sim3(scale, np.eye(3), -scale * center), float(near), float(far), background)


def frame_around(
    center: Float[np.ndarray, "3"], radius: float, distances: Float[np.ndarray, "v"], background: Float[np.ndarray, "3"]
) -> FieldFrame:
    """The frame in which a cube of half side `radius` around a centre has the half side `NORMALIZED_RADIUS`.

    Args:
        distances: Of the cameras from the centre.
    """
    scale = NORMALIZED_RADIUS / radius
    reach = np.sqrt(3.0) * NORMALIZED_RADIUS
    near = max(scale * float(np.min(distances)) - reach, 0.05)
    return FieldFrame(
        Sim3(scale, np.eye(3), -scale * center), near, scale * float(np.max(distances)) + reach, background
    )


def default_background(photos: DecodedPhotos) -> Float[np.ndarray, "3"]:
    """White where the photos have an alpha channel, else the mean colour of what masks leave of the photos.

    Without alpha, whatever light passes the field must look like something; the mean colour is the guess with the
    least error, and a black one would tempt a young field to fade to black everywhere.
    """
    if any(pixels.shape[2] == 4 for pixels in photos.pixels):
        return np.array(WHITE)
    seen = [pixels if keep is None else pixels[keep] for pixels, keep in zip(photos.pixels, photos.keep, strict=True)]
    means = [pixels.reshape(-1, 3).mean(axis=0) for pixels in seen if pixels.size]
    return np.mean(means, axis=0) / 255.0 if means else np.full(3, 0.5)
