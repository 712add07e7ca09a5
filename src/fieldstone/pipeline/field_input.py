"""From a folder to what a field learns from: posed photos, the held-out ones, frame and range."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from fieldstone.errors import InputError
from fieldstone.field.ray_dataset import (
    PosedImage,
    RayDataset,
    blender_frame,
    default_background,
    frame_from_points,
    reduce_images,
    split_every,
)
from fieldstone.io.blender import BlenderScene, is_blender_folder, read_blender, read_split
from fieldstone.io.colmap import find_colmap_model, read_colmap
from fieldstone.io.photos import Photo, read_photo
from fieldstone.scene.reconstruction import Reconstruction

logger = logging.getLogger(__name__)

MIN_SIDE_PX = 11
"""SSIM has a window of this size."""


def read_ray_dataset(source: Path, photos: Path | None, image_size_px: int) -> RayDataset:
    """The dataset of a Blender-format folder, or of one with a COLMAP model and its photos.

    Blender: photos of the train split, held out those of the test split (of the validation split without one), rays
    from 2 to 6 on white. COLMAP: every 8th photo by name is held out; range and frame follow from the points.

    Args:
        photos: Folder with the photos of a COLMAP model; None: `images` beside the model, where the reconstruction
            took them from, or the folder of the model.
        image_size_px: Photos are reduced to this length of their longer side.

    Raises:
        InputError: Neither kind of folder, photos missing, or nothing to train on.
    """
    if is_blender_folder(source):
        dataset = _blender_dataset(source, image_size_px)
    elif find_colmap_model(source) is not None:
        dataset = _colmap_dataset(source, photos, image_size_px)
    else:
        raise InputError(
            f"{source}: no posed photos; needs transforms_train.json (Blender format) or sparse/0 "
            "(run `fieldstone reconstruct` on the photos first)"
        )
    for image in (*dataset.train, *dataset.test):
        if min(image.pixels.shape[:2]) < MIN_SIDE_PX:
            raise InputError(f"{image.name}: smaller than {MIN_SIDE_PX} pixels after reduction; use larger photos")
    logger.info(
        "%d photos to train on, %d held out, rays from %.3g to %.3g",
        len(dataset.train),
        len(dataset.test),
        dataset.frame.near,
        dataset.frame.far,
    )
    return dataset


def view_labels(names: Sequence[str]) -> list[str]:
    """File names without suffix for views: a folder that all share is left out, a suffix unless two would collide."""
    paths = [PurePosixPath(name) for name in names]
    if paths and len({path.parent for path in paths}) == 1:
        paths = [PurePosixPath(path.name) for path in paths]
    stems = [str(path.with_suffix("")) for path in paths]
    return [stem if stems.count(stem) == 1 else str(path) for stem, path in zip(stems, paths, strict=True)]


def _blender_dataset(folder: Path, image_size_px: int) -> RayDataset:
    scene = read_blender(folder)
    held_out = next((split for split in ("test", "val") if scene.splits.get(split)), None)
    train = reduce_images(_blender_images(scene, "train"), image_size_px)
    test = reduce_images(_blender_images(scene, held_out), image_size_px) if held_out else ()
    return RayDataset(train, test, blender_frame(scene.near, scene.far), np.empty((0, 3)))


def _blender_images(scene: BlenderScene, split: str) -> tuple[PosedImage, ...]:
    photos, _ = read_split(scene, split)
    return tuple(
        PosedImage(frame.name, scene.camera, frame.cam_from_world, pixels_of(photo)) for frame, photo in photos
    )


def _colmap_dataset(source: Path, photos: Path | None, image_size_px: int) -> RayDataset:
    model = read_colmap(source)
    folder = photos or _photo_folder(source, model)
    images = []
    for i in model.registered().tolist():
        view = model.views[i]
        try:
            images.append(
                PosedImage(view.name, model.camera_of(i), model.pose_of(i), pixels_of(read_photo(folder / view.name)))
            )
        except InputError as error:
            logger.warning("skipped %s", error)
    if not images:
        raise InputError(f"{folder}: holds none of the {len(model.registered())} photos of the model; give --photos")
    reduced = reduce_images(tuple(images), image_size_px)
    train, test = split_every([image.name for image in images])
    background = default_background(tuple(reduced[i] for i in train))
    return RayDataset(
        tuple(reduced[i] for i in train),
        tuple(reduced[i] for i in test),
        frame_from_points(model, background),
        model.points.xyz,
    )


def _photo_folder(source: Path, model: Reconstruction) -> Path:
    """Where the photos of a model lie."""
    candidates = [source / "images"]
    try:
        record = json.loads((source / "run.json").read_text())
        candidates.append(source / str(record["photos_folder"]))
    except (OSError, ValueError, KeyError, TypeError):
        logger.debug("%s: no run.json that says where the photos are", source)
    candidates.append(source)
    names = [model.views[i].name for i in model.registered().tolist()]
    for folder in candidates:
        if any((folder / name).is_file() for name in names):
            return folder
    searched = ", ".join(str(candidate) for candidate in candidates)
    raise InputError(f"{source}: the photos of the model are in none of {searched}; give --photos FOLDER")


def pixels_of(photo: Photo) -> np.ndarray:
    """RGB or, where the photo has transparency, RGBA pixels."""
    return photo.rgb if photo.alpha is None else np.dstack([photo.rgb, photo.alpha])
