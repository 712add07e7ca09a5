"""From a source of posed photos to what a field learns from: decoded photos, the held-out ones, frame and range."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import (
    RayDataset,
    blender_frame,
    default_background,
    frame_around,
    frame_from_points,
    frame_from_seen,
    reduce_photos,
    split_every,
)
from fieldstone.field.evidence.borders import kept_inside_borders
from fieldstone.field.evidence.sparse_depth import seen_points
from fieldstone.geometry.camera import image_from_cam
from fieldstone.io.images.masks import find_masks, read_mask
from fieldstone.io.images.photos import read_photo, read_photo_info
from fieldstone.io.posed.open import open_posed_scene
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.rendering.camera_paths import focus_point
from fieldstone.scene.photos import DecodedPhotos, PosedPhotos

logger = logging.getLogger(__name__)

MIN_SIDE_PX = 11
"""SSIM has a window of this size."""

MIN_POINTS = 10
"""Fewer points say nothing about the range of a scene."""

OPEN_RADIUS, MASKED_RADIUS = 0.65, 0.6
"""Half side of the box over the distance of the cameras from what they look at, where nothing else is known."""


@dataclass(frozen=True, eq=False)
class Split:
    """Indices of the photos of a scene to learn from, and of those to measure with."""

    train: Int[np.ndarray, "_"]
    test: Int[np.ndarray, "_"]


def read_ray_dataset(
    source: Path, photos: Path | None, image_size_px: int, *, hold_out: Sequence[str] | None = None
) -> RayDataset:
    """The dataset of a folder with posed photos; see `open_posed_scene`.

    Args:
        photos: Folder with the photos of a COLMAP model; None: `images` beside the model, where the reconstruction
            took them from, or the folder of the model.
        image_size_px: Photos are reduced to this length of their longer side.
        hold_out: Photos to hold out instead of those of the source, see `holding_out`.

    Raises:
        InputError: No posed photos, photos missing, or nothing to train on.
    """
    scene = open_posed_scene(source, photos)
    return dataset_of(scene, holding_out(scene, hold_out), image_size_px)


def dataset_of(scene: PosedScene, split: Split, image_size_px: int, *, held_out: bool = True) -> RayDataset:
    """Decode the photos of a scene; held_out=False leaves the held-out ones unread.

    Raises:
        InputError: No photo to train on can be read, or nothing says how far the scene is.
    """
    train, rows = decode_photos(scene.photos.select(split.train), image_size_px, without_borders=True)
    test, _ = decode_photos(scene.photos.select(split.test if held_out else ()), image_size_px)
    if not len(train):
        raise InputError(f"none of {len(split.train)} photos to train on can be read, or all were held out")
    background = default_background(train)
    frame, bounded = frame_of(scene, background) or _frame_from_cameras(train, background)
    logger.info(
        "%d photos to train on, %d held out, rays from %.3g to %.3g", len(train), len(split.test), frame.near, frame.far
    )
    seen = ()
    if scene.model is not None and scene.view_of_photo is not None:
        seen = seen_points(scene.model, scene.view_of_photo[split.train][rows].tolist())
    return RayDataset(train, test, frame, scene.points_in_world, bounded, seen)


def default_split(scene: PosedScene) -> Split:
    """As the files say; else every 8th photo by name is held out."""
    if scene.splits:
        return Split(scene.splits["train"], scene.held_out())
    train, test = split_every(list(scene.photos.names))
    return Split(np.array(train, dtype=np.int64), np.array(test, dtype=np.int64))


def holding_out(scene: PosedScene, names: Sequence[str] | None) -> Split:
    """The photos of the default split, divided in another way.

    Args:
        names: Of the photos to hold out, or of their files with or without folder and suffix; empty: all are learned
            from. None: the default split.

    Raises:
        InputError: There is no such photo.
    """
    split = default_split(scene)
    if names is None:
        return split
    rows = np.concatenate([split.train, split.test])
    paths = _paths(scene.photos)
    known = [{scene.photos.names[i], paths[i].name, paths[i].stem} for i in rows.tolist()]
    for name in names:
        if not any(name in of_photo for of_photo in known):
            some = ", ".join(paths[i].name for i in rows[:5].tolist())
            raise InputError(f"`hold_out` {name}: no such photo among {len(rows)} ({some}, ...)")
    held_out = np.array([not of_photo.isdisjoint(names) for of_photo in known], dtype=bool)
    return Split(rows[~held_out], rows[held_out])


def with_masks(scene: PosedScene, split: Split, masks: Path) -> PosedScene:
    """The scene with the masks of a folder for the photos of a split, see `io.images.masks.find_masks`.

    Raises:
        InputError: No such folder, no mask for any photo, or a mask of another size than its photo.
    """
    paths = _paths(scene.photos)
    asked = np.concatenate([split.train, split.test]).tolist()
    found = find_masks(masks, {scene.photos.names[i]: paths[i] for i in asked})
    return replace(scene, photos=replace(scene.photos, masks=tuple(found.get(path) for path in paths)))


def decode_photos(
    posed: PosedPhotos, image_size_px: int, *, without_borders: bool = False
) -> tuple[DecodedPhotos, Int[np.ndarray, "_"]]:
    """Decoded and reduced photos, and which ones they are: those that cannot be read are left out with a warning.

    Args:
        without_borders: Mask the black border that all photos of a camera share.

    Raises:
        InputError: A photo is too small, or does not have the size of its camera or its mask.
    """
    paths, masks = _paths(posed), posed.masks or (None,) * len(posed)

    def decoded(i: int) -> tuple[np.ndarray, np.ndarray | None]:
        photo, mask = read_photo(paths[i]), masks[i]
        return photo.pixels, None if mask is None else read_mask(mask, photo.info)

    read: list[tuple[int, UInt8[np.ndarray, "_ _ _"], Bool[np.ndarray, "_ _"] | None]] = []
    with ThreadPoolExecutor() as pool:
        # Decoding leaves Python's lock; results are taken in order.
        for i, result in enumerate([pool.submit(decoded, i) for i in range(len(posed))]):
            try:
                read.append((i, *result.result()))
            except InputError as error:
                logger.warning("skipped %s", error)
    rows = np.array([i for i, _, _ in read], dtype=np.int64)
    photos = DecodedPhotos(posed.select(rows), tuple(p for _, p, _ in read), tuple(k for _, _, k in read))
    photos = reduce_photos(_without_borders(photos) if without_borders else photos, image_size_px)
    for name, pixels in zip(photos.posed.names, photos.pixels, strict=True):
        if min(pixels.shape[:2]) < MIN_SIDE_PX:
            raise InputError(f"{name}: smaller than {MIN_SIDE_PX} pixels after reduction; use larger photos")
    return photos, rows


def _without_borders(photos: DecodedPhotos) -> DecodedPhotos:
    """Photos without masks of their own get one of the border that all photos of their camera share."""
    keep = list(photos.keep)
    for of_camera in photos.posed.photos_of_cameras():
        inside = kept_inside_borders([photos.pixels[v] for v in of_camera.tolist()])
        if inside is None:
            continue
        logger.info("black border of %.1f %% of the photos left out", 100 * (1 - inside.mean()))
        for v in of_camera.tolist():
            keep[v] = inside if keep[v] is None else keep[v]
    return replace(photos, keep=tuple(keep))


def check_sizes(posed: PosedPhotos) -> None:
    """Compare photos with their cameras by what their headers say; those that cannot be read are for later.

    Raises:
        InputError: A photo does not have the size of its camera.
    """
    for i, path in enumerate(_paths(posed)):
        try:
            info = read_photo_info(path)
        except InputError:
            continue
        camera = posed.camera_of(i)
        if (info.width, info.height) != (camera.width, camera.height):
            raise InputError(
                f"{path}: {info.width}x{info.height} pixels, but its camera has {camera.width}x{camera.height}; "
                "use the photos that were posed"
            )


def view_labels(names: Sequence[str]) -> list[str]:
    """File names without suffix for views: a folder that all share is left out, a suffix unless two would collide."""
    paths = [PurePosixPath(name) for name in names]
    if paths and len({path.parent for path in paths}) == 1:
        paths = [PurePosixPath(path.name) for path in paths]
    stems = [str(path.with_suffix("")) for path in paths]
    return [stem if stems.count(stem) == 1 else str(path) for stem, path in zip(stems, paths, strict=True)]


def _paths(posed: PosedPhotos) -> tuple[Path, ...]:
    if posed.paths is None:
        raise InputError("these photos came from no files, so they cannot be decoded")
    return posed.paths


def frame_of(scene: PosedScene, background: Float[np.ndarray, "3"]) -> tuple[FieldFrame, bool] | None:
    """The frame of a scene and whether nothing lies beyond its box; None: neither range, box nor points are known.

    The range follows from what the format says, from the observations of a model, from a stated box, or from the
    points that lie in the photos.

    Raises:
        InputError: A model with hardly any observation.
    """
    if scene.depth_range is not None:
        return blender_frame(*scene.depth_range), True
    if scene.model is not None:
        return frame_from_points(scene.model, background), False
    # Those of the default split, so that the frame does not depend on which photos are held out.
    train = scene.photos.select(default_split(scene).train)
    if scene.box is not None:
        middle, radius = scene.box.mean(axis=0), 0.5 * float(np.ptp(scene.box, axis=0).max())
        distances = np.linalg.norm(train.centers() - middle, axis=1)
        return frame_around(middle, radius, distances, background), True
    distances = _distances_seen(train, scene.points_in_world)
    if len(distances) < MIN_POINTS:
        return None
    return frame_from_seen(scene.points_in_world, distances, background), False


def _distances_seen(photos: PosedPhotos, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "o"]:
    """Distances of the points that lie in each photo, of all photos."""
    parts = [np.empty(0)]
    for v in range(len(photos)):
        camera = photos.camera_of(v)
        in_cam = photos.pose_of(v).apply(points)
        pixels = image_from_cam(camera, in_cam)
        inside = np.all((pixels >= -0.5) & (pixels <= np.array([camera.width, camera.height]) + 0.5), axis=1)
        parts.append(np.linalg.norm(in_cam[inside], axis=1))
    return np.concatenate(parts)


def _frame_from_cameras(photos: DecodedPhotos, background: Float[np.ndarray, "3"]) -> tuple[FieldFrame, bool]:
    """The frame around what the cameras look at, and whether that is all there is: photos with alpha show an object."""
    middle, centers = focus_point(photos.posed.cam_from_world), photos.posed.centers()
    distances = np.linalg.norm(centers - middle, axis=1)
    bounded = photos.have_alpha
    radius = (MASKED_RADIUS if bounded else OPEN_RADIUS) * float(np.median(distances))
    if not np.ptp(centers, axis=0).max() > 1e-6 * radius or not radius > 1e-3 * np.ptp(centers, axis=0).max():
        raise InputError("all cameras stand at one place: nothing says how far the scene is; give points or a box")
    frame = frame_around(middle, radius, distances, background)
    return (frame if bounded else replace(frame, near=0.1 * frame.far)), bounded
