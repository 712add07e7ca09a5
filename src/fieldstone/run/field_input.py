"""From a folder to what a field learns from: posed photos, the held-out ones, frame and range."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import (
    PosedImage,
    RayDataset,
    SeenPoints,
    blender_frame,
    default_background,
    frame_around,
    frame_from_points,
    frame_from_seen,
    reduce_images,
    split_every,
)
from fieldstone.field.evidence.borders import kept_inside_borders
from fieldstone.field.evidence.sparse_depth import seen_points
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.masks import find_masks, read_mask
from fieldstone.io.images.photos import read_photo, read_photo_info
from fieldstone.io.models.colmap import find_colmap_model, read_colmap
from fieldstone.io.posed.blender import BlenderScene, is_blender_folder, read_blender
from fieldstone.io.posed.llff import is_llff_folder, read_llff
from fieldstone.io.posed.posed_photos import PosedPhoto, PosedScene
from fieldstone.io.posed.transforms_json import find_transforms, read_transforms
from fieldstone.render.camera_paths import focus_point
from fieldstone.scene.reconstruction import Reconstruction

logger = logging.getLogger(__name__)

MIN_SIDE_PX = 11
"""SSIM has a window of this size."""

MIN_POINTS = 10
"""Fewer points say nothing about the range of a scene."""

OPEN_RADIUS, MASKED_RADIUS = 0.65, 0.6
"""Half side of the box over the distance of the cameras from what they look at, where nothing else is known."""

UNKNOWN = np.zeros(3)
"""Background of a frame until the photos are read."""


@dataclass(frozen=True, eq=False)
class FieldInput:
    """What a folder says, before any photo is decoded."""

    train: tuple[PosedPhoto, ...]
    test: tuple[PosedPhoto, ...]
    points_in_world: np.ndarray
    frame: FieldFrame | None
    """None: depends on whether the photos have alpha, and on the cameras alone."""
    bounded: bool
    seen: Mapping[str, SeenPoints] = field(default_factory=dict)
    """What each photo is known to see, by its name."""


def read_ray_dataset(
    source: Path, photos: Path | None, image_size_px: int, *, hold_out: Sequence[str] | None = None
) -> RayDataset:
    """The dataset of a folder with posed photos; see `open_field_input`.

    Args:
        photos: Folder with the photos of a COLMAP model; None: `images` beside the model, where the reconstruction
            took them from, or the folder of the model.
        image_size_px: Photos are reduced to this length of their longer side.
        hold_out: Photos to hold out instead of those of the source, see `holding_out`.

    Raises:
        InputError: No posed photos, photos missing, or nothing to train on.
    """
    return dataset_of(holding_out(open_field_input(source, photos), hold_out), image_size_px)


def dataset_of(given: FieldInput, image_size_px: int, *, held_out: bool = True) -> RayDataset:
    """Decode the photos of an input; held_out=False leaves the held-out ones unread."""
    train = read_images(given.train, image_size_px, without_borders=True)
    test = read_images(given.test, image_size_px) if held_out else ()
    if not train:
        raise InputError(f"none of {len(given.train)} photos to train on can be read, or all were held out")
    frame, bounded = given.frame, given.bounded
    if frame is None:
        frame, bounded = _frame_from_cameras(train)
    if frame.background is UNKNOWN:
        frame = replace(frame, background=default_background(train))
    logger.info(
        "%d photos to train on, %d held out, rays from %.3g to %.3g",
        len(train),
        len(given.test),
        frame.near,
        frame.far,
    )
    return RayDataset(train, test, frame, given.points_in_world, bounded, given.seen)


def holding_out(given: FieldInput, names: Sequence[str] | None) -> FieldInput:
    """The input with other photos held out.

    Args:
        names: Of the photos, or of their files with or without folder and suffix; empty: all are learned from. None:
            nothing changes.

    Raises:
        InputError: There is no such photo.
    """
    if names is None:
        return given
    photos = (*given.train, *given.test)
    known = [{photo.name, photo.path.name, photo.path.stem} for photo in photos]
    for name in names:
        if not any(name in of_photo for of_photo in known):
            some = ", ".join(photo.path.name for photo in photos[:5])
            raise InputError(f"--hold-out {name}: no such photo among {len(photos)} ({some}, ...)")
    tested = [not of_photo.isdisjoint(names) for of_photo in known]
    train, test = (tuple(p for p, out in zip(photos, tested, strict=True) if out == held) for held in (False, True))
    return replace(given, train=train, test=test)


def _masked_borders(images: Sequence[PosedImage]) -> list[PosedImage]:
    """Photos without masks of their own get one of the border that all photos of their camera share."""
    kept = {}
    for camera in {id(image.camera): image.camera for image in images}.values():
        kept[id(camera)] = kept_inside_borders([image for image in images if image.camera is camera])
        if (keep := kept[id(camera)]) is not None:
            logger.info("black border of %.1f %% of the photos left out", 100 * (1 - keep.mean()))
    return [replace(image, keep=kept[id(image.camera)]) if image.keep is None else image for image in images]


def with_masks(given: FieldInput, masks: Path | None, source: Path) -> FieldInput:
    """The input with the masks of a folder, see `io.images.masks.find_masks`.

    Args:
        masks: None: those that the reconstruction in `source` was made with, or those that the input names.

    Raises:
        InputError: No such folder, no mask for any photo, or a mask of another size than its photo.
    """
    if masks is None and (named := _recorded(source, "masks_folder")) is not None and named.is_dir():
        masks = named
    if masks is None:
        return given
    found = find_masks(masks, [photo.path for photo in (*given.train, *given.test)])

    def masked(photos: Sequence[PosedPhoto]) -> tuple[PosedPhoto, ...]:
        return tuple(replace(photo, mask=found.get(photo.path)) for photo in photos)

    return replace(given, train=masked(given.train), test=masked(given.test))


def open_field_input(source: Path, photos: Path | None = None) -> FieldInput:
    """Which photos with which cameras a source holds, and how far the scene reaches.

    Blender folder: photos of the train split, held out those of the test split (of the validation split without one),
    rays from 2 to 6 on white. COLMAP model, LLFF, `transforms.json`: every 8th photo by name is held out, unless the
    file has a split of its own; the range follows from points, from a stated box, or from the cameras.

    Raises:
        InputError: No posed photos, or a damaged file.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    if source.is_dir() and is_blender_folder(source):
        return _blender_input(source)
    if source.is_dir() and find_colmap_model(source) is not None:
        return _colmap_input(source, photos)
    if source.is_dir() and is_llff_folder(source):
        return _input_of(read_llff(source, photos))
    if (path := find_transforms(source)) is not None:
        return _input_of(read_transforms(path))
    raise InputError(
        f"{source}: no posed photos; needs transforms_train.json (Blender format), transforms.json (nerfstudio, "
        "instant-ngp), poses_bounds.npy (LLFF) or sparse/0 (run `fieldstone reconstruct` on the photos first)"
    )


def read_images(
    photos: Sequence[PosedPhoto], image_size_px: int, *, without_borders: bool = False
) -> tuple[PosedImage, ...]:
    """Decoded and reduced photos; those that cannot be read are left out with a warning.

    Args:
        without_borders: Mask the black border that all photos of a camera share.

    Raises:
        InputError: A photo is too small, or does not have the size of its camera or its mask.
    """

    def decoded(photo: PosedPhoto) -> tuple[np.ndarray, np.ndarray | None]:
        found = read_photo(photo.path)
        return found.pixels, None if photo.mask is None else read_mask(photo.mask, found.info)

    images = []
    with ThreadPoolExecutor() as pool:
        # Decoding leaves Python's lock; results are taken in order.
        reading = [pool.submit(decoded, photo) for photo in photos]
        for photo, result in zip(photos, reading, strict=True):
            try:
                pixels, keep = result.result()
            except InputError as error:
                logger.warning("skipped %s", error)
                continue
            images.append(PosedImage(photo.name, photo.camera, photo.cam_from_world, pixels, keep))
    if without_borders:
        images = _masked_borders(images)
    reduced = reduce_images(tuple(images), image_size_px)
    for image in reduced:
        if min(image.pixels.shape[:2]) < MIN_SIDE_PX:
            raise InputError(f"{image.name}: smaller than {MIN_SIDE_PX} pixels after reduction; use larger photos")
    return reduced


def check_sizes(photos: Sequence[PosedPhoto]) -> None:
    """Compare photos with their cameras by what their headers say; those that cannot be read are for later.

    Raises:
        InputError: A photo does not have the size of its camera.
    """
    for photo in photos:
        try:
            info = read_photo_info(photo.path)
        except InputError:
            continue
        camera = photo.camera
        if (info.width, info.height) != (camera.width, camera.height):
            raise InputError(
                f"{photo.path}: {info.width}x{info.height} pixels, but its camera has {camera.width}x{camera.height}; "
                "use the photos that were posed"
            )


def view_labels(names: Sequence[str]) -> list[str]:
    """File names without suffix for views: a folder that all share is left out, a suffix unless two would collide."""
    paths = [PurePosixPath(name) for name in names]
    if paths and len({path.parent for path in paths}) == 1:
        paths = [PurePosixPath(path.name) for path in paths]
    stems = [str(path.with_suffix("")) for path in paths]
    return [stem if stems.count(stem) == 1 else str(path) for stem, path in zip(stems, paths, strict=True)]


def _blender_input(folder: Path) -> FieldInput:
    scene = read_blender(folder)
    held_out = next((split for split in ("test", "val") if scene.splits.get(split)), None)
    test = _blender_photos(scene, held_out) if held_out else ()
    frame = blender_frame(scene.near, scene.far)
    return FieldInput(_blender_photos(scene, "train"), test, np.empty((0, 3)), frame, bounded=True)


def _blender_photos(scene: BlenderScene, split: str) -> tuple[PosedPhoto, ...]:
    return tuple(PosedPhoto(f.name, f.path, scene.camera, f.cam_from_world) for f in scene.splits[split])


def _input_of(scene: PosedScene) -> FieldInput:
    train, test = scene.train, scene.test
    if test is None:
        kept, held_out = split_every([photo.name for photo in train])
        train, test = tuple(train[i] for i in kept), tuple(train[i] for i in held_out)
    centers = _centers(train)
    if scene.box is not None:
        middle, radius = scene.box.mean(axis=0), 0.5 * float(np.ptp(scene.box, axis=0).max())
        distances = np.linalg.norm(centers - middle, axis=1)
        frame = frame_around(middle, radius, distances, UNKNOWN)
        return FieldInput(train, test, scene.points_in_world, frame, bounded=True)
    distances = _distances_seen(train, scene.points_in_world)
    if len(distances) < MIN_POINTS:
        return FieldInput(train, test, np.empty((0, 3)), None, bounded=True)
    frame = frame_from_seen(scene.points_in_world, distances, UNKNOWN)
    return FieldInput(train, test, scene.points_in_world, frame, bounded=False)


def _centers(photos: Sequence[PosedPhoto]) -> np.ndarray:
    return np.array([photo.cam_from_world.target_origin_in_source() for photo in photos]).reshape(-1, 3)


def _distances_seen(photos: Sequence[PosedPhoto], points: np.ndarray) -> np.ndarray:
    """Distances of the points that lie in each photo, of all photos."""
    parts = [np.empty(0)]
    for photo in photos:
        in_cam = photo.cam_from_world.apply(points)
        pixels = image_from_cam(photo.camera, in_cam)
        size = np.array([photo.camera.width, photo.camera.height])
        inside = np.all((pixels >= -0.5) & (pixels <= size + 0.5), axis=1)
        parts.append(np.linalg.norm(in_cam[inside], axis=1))
    return np.concatenate(parts)


def _frame_from_cameras(images: tuple[PosedImage, ...]) -> tuple[FieldFrame, bool]:
    """The frame around what the cameras look at, and whether that is all there is: photos with alpha show an object."""
    poses = Rigid3.stack([image.cam_from_world for image in images])
    middle, centers = focus_point(poses), poses.target_origin_in_source()
    distances = np.linalg.norm(centers - middle, axis=1)
    bounded = all(image.pixels.shape[2] == 4 for image in images)
    radius = (MASKED_RADIUS if bounded else OPEN_RADIUS) * float(np.median(distances))
    if not np.ptp(centers, axis=0).max() > 1e-6 * radius or not radius > 1e-3 * np.ptp(centers, axis=0).max():
        raise InputError("all cameras stand at one place: nothing says how far the scene is; give points or a box")
    frame = frame_around(middle, radius, distances, UNKNOWN)
    return (frame if bounded else replace(frame, near=0.1 * frame.far)), bounded


def _colmap_input(source: Path, photos: Path | None) -> FieldInput:
    model = read_colmap(source)
    folder = photos or _photo_folder(source, model)
    found = []
    for i in model.registered().tolist():
        view = model.views[i]
        if (folder / view.name).is_file():
            found.append(PosedPhoto(view.name, folder / view.name, model.camera_of(i), model.pose_of(i)))
        else:
            logger.warning("skipped %s: no such file", folder / view.name)
    if not found:
        raise InputError(f"{folder}: holds none of the {len(model.registered())} photos of the model; give --photos")
    train, test = split_every([photo.name for photo in found])
    return FieldInput(
        tuple(found[i] for i in train),
        tuple(found[i] for i in test),
        model.points.xyz,
        frame_from_points(model, UNKNOWN),
        bounded=False,
        seen=seen_points(model),
    )


def _photo_folder(source: Path, model: Reconstruction) -> Path:
    """Where the photos of a model lie."""
    recorded = _recorded(source, "photos_folder")
    candidates = [source / "images", *([] if recorded is None else [recorded]), source]
    names = [model.views[i].name for i in model.registered().tolist()]
    for folder in candidates:
        if any((folder / name).is_file() for name in names):
            return folder
    searched = ", ".join(str(candidate) for candidate in candidates)
    raise InputError(f"{source}: the photos of the model are in none of {searched}; give --photos FOLDER")


def _recorded(source: Path, name: str) -> Path | None:
    """A folder that the run.json of a reconstruction names, relative to it."""
    try:
        return source / str(json.loads((source / "run.json").read_text())[name])
    except (OSError, ValueError, KeyError, TypeError):
        logger.debug("%s: no run.json that names %s", source, name)
        return None
