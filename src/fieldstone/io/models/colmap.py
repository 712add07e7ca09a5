"""COLMAP models, the common tongue of posed photos: read and write, binary and text.

Pixels, camera axes and pose direction are COLMAP's in all of fieldstone, so only ids and quaternions change here.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_together
from fieldstone.io.files.names import name_problem
from fieldstone.io.models.colmap_binary import decode_binary, encode_binary
from fieldstone.io.models.colmap_tables import NO_POINT, ColmapImage, ColmapTables
from fieldstone.io.models.colmap_text import decode_text, encode_text
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations

logger = logging.getLogger(__name__)

FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model with what a `Reconstruction` does not hold: all keypoints, and the ids of the files.

    Views and points are in the order of their ids; `observations.keypoint` counts in `keypoints` of the view.
    """

    reconstruction: Reconstruction
    keypoints: tuple[Float[np.ndarray, "_ 2"], ...]
    camera_ids: Int[np.ndarray, "c"]
    image_ids: Int[np.ndarray, "v"]
    point_ids: Int[np.ndarray, "p"]
    point_errors: Float[np.ndarray, "p"]
    """Mean reprojection error in pixels as the file states it; -1 if it was never computed."""


def find_colmap_model(folder: Path) -> Path | None:
    """The folder that holds the model's files: `folder` itself, `sparse/0` or `sparse` below it; None if none does."""
    for candidate in (folder, folder / "sparse" / "0", folder / "sparse"):
        if any(all((candidate / f"{name}.{suffix}").is_file() for name in FILES) for suffix in ("bin", "txt")):
            return candidate
    return None


def read_colmap(folder: Path) -> Reconstruction:
    """The reconstruction of a model folder; see `read_colmap_model`."""
    return read_colmap_model(folder).reconstruction


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read a model: binary if both kinds are there, with or without rigs and frames (poses are per image anyway).

    Raises:
        InputError: No model there; a file is damaged; an image names a camera, or a track a keypoint, that the model
            lacks; or a point is not finite.
    """
    found = find_colmap_model(folder)
    if found is None:
        raise InputError(f"{folder}: no COLMAP model; needs cameras, images and points3D, all .bin or all .txt")
    is_binary = all((found / f"{name}.bin").is_file() for name in FILES)
    tables = decode_binary(found) if is_binary else decode_text(found)
    return _model_from_tables(tables, found)


def write_colmap(
    model: Reconstruction,
    folder: Path,
    *,
    keypoints: Sequence[Float[np.ndarray, "_ 2"]] | None = None,
    binary: bool = True,
) -> None:
    """Write the registered views, with rigs and frames (one rig per camera); all files appear together.

    Ids are indices plus one. Each point carries its mean reprojection error in pixels.

    Args:
        keypoints: All keypoints of every view, so that keypoint numbers stay what they are. Without them the observed
            ones are written, in their order, and numbered anew.

    Raises:
        InputError: A name that text cannot hold, or a text model on top of a binary one, which readers would prefer.
        ValueError: Nothing is registered, one keypoint shows two points, or an observed view has no pose.
    """
    if not binary and any((folder / f"{name}.bin").exists() for name in FILES):
        raise InputError(f"{folder}: holds a binary model, which readers prefer to text; choose another folder")
    tables = _tables_from_reconstruction(model, keypoints)
    write_together(folder, encode_binary(tables) if binary else encode_text(tables))


def _model_from_tables(tables: ColmapTables, folder: Path) -> ColmapModel:
    """Ids become indices; every reference is checked."""
    camera_ids = sorted(tables.cameras)
    images = sorted(tables.images, key=lambda image: image.image_id)
    image_ids = np.array([image.image_id for image in images], dtype=np.int64)
    for kind, values in (("image id", image_ids.tolist()), ("name", [image.name for image in images])):
        if len(set(values)) < len(values):
            raise InputError(f"{folder}: two images have the same {kind}; write the model again")
    for image in images:
        if image.camera_id not in tables.cameras:
            raise InputError(f"{folder}: image {image.name} has camera {image.camera_id}, which the model lacks")
    not_finite = np.flatnonzero(~np.isfinite(tables.xyz).all(axis=1))
    if len(not_finite):
        raise InputError(f"{folder}: point {tables.point_id[not_finite[0]]} is not finite; remove it")
    if len(np.unique(tables.point_id)) < len(tables.point_id):
        raise InputError(f"{folder}: two points have the same id; write the model again")
    order = np.argsort(tables.point_id, kind="stable")
    views = tuple(View(i.name, camera_ids.index(i.camera_id), i.cam_from_world) for i in images)
    reconstruction = Reconstruction(
        tuple(tables.cameras[i] for i in camera_ids),
        views,
        Points(tables.xyz[order], tables.rgb[order]),
        _observations(tables, images, image_ids, order, folder),
    )
    return ColmapModel(
        reconstruction,
        tuple(image.pixels for image in images),
        np.array(camera_ids, dtype=np.int64),
        image_ids,
        tables.point_id[order],
        tables.error[order],
    )


def _observations(
    tables: ColmapTables,
    images: list[ColmapImage],
    image_ids: Int[np.ndarray, "v"],
    order: Int[np.ndarray, "p"],
    folder: Path,
) -> Observations:
    """Tracks with indices, sorted by point; those in images whose keypoints were stripped are dropped and counted."""
    view = np.searchsorted(image_ids, tables.track_image)
    known = view < len(images)
    known[known] = image_ids[view[known]] == tables.track_image[known]
    num_keypoints = np.array([len(image.pixels) for image in images] + [0], dtype=np.int64)[view * known]
    for wrong, why in (
        (~known, "which the model lacks"),
        (known & (num_keypoints > 0) & ((tables.track_keypoint >= num_keypoints) | (tables.track_keypoint < 0)), ""),
    ):
        if wrong.any():
            k = int(np.argmax(wrong))
            point, image = tables.point_id[tables.track_row[k]], tables.track_image[k]
            why = why or f"which has {num_keypoints[k]} keypoints, not number {tables.track_keypoint[k]}"
            raise InputError(f"{folder}: the track of point {point} names image {image}, {why}; write the model again")
    kept = num_keypoints > 0
    if not kept.all():
        logger.warning("%s: %d track elements dropped, their images have no keypoints", folder, int((~kept).sum()))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    point, view, keypoint = rank[tables.track_row[kept]], view[kept], tables.track_keypoint[kept]
    by_point = np.argsort(point, kind="stable")
    point, view, keypoint = point[by_point], view[by_point], keypoint[by_point]
    offsets = np.cumsum([0] + [len(image.pixels) for image in images])
    all_pixels = np.concatenate([np.empty((0, 2)), *(image.pixels for image in images)])
    return Observations(view, keypoint, point, all_pixels[offsets[view] + keypoint])


def _tables_from_reconstruction(
    model: Reconstruction, keypoints: Sequence[Float[np.ndarray, "_ 2"]] | None
) -> ColmapTables:
    """Indices become ids."""
    observations = model.observations
    registered = model.registered().tolist()
    if not registered:
        raise ValueError("no view is registered: there is no model to write")
    among_observed = model.keypoints_among_observed()
    written_keypoint = among_observed if keypoints is None else observations.keypoint
    images = []
    for v in registered:
        view = model.views[v]
        if problem := name_problem(view.name):
            raise InputError(f"view {v}: {problem}")
        rows = np.flatnonzero(observations.view == v)
        place = written_keypoint[rows]
        if keypoints is None:
            pixels = np.empty((len(rows), 2))
            pixels[place] = observations.pixels[rows]
        else:
            pixels = keypoints[v]
        point_id = np.full(len(pixels), NO_POINT, dtype=np.int64)
        point_id[place] = observations.point[rows] + 1
        images.append(ColmapImage(v + 1, view.camera + 1, view.name, model.pose_of(v), pixels, point_id))
    used_cameras = sorted({model.views[v].camera for v in registered})
    return ColmapTables(
        cameras={c + 1: model.cameras[c] for c in used_cameras},
        images=images,
        point_id=np.arange(1, len(model.points) + 1),
        xyz=model.points.xyz,
        rgb=model.points.rgb,
        error=_mean_errors(model),
        track_row=observations.point,
        track_image=observations.view + 1,
        track_keypoint=written_keypoint,
    )


def _mean_errors(model: Reconstruction) -> Float[np.ndarray, "p"]:
    """Mean reprojection error of each point in pixels, over the views that have it in front; -1 without any."""
    errors = model.reprojection_errors()
    finite = np.isfinite(errors)
    count = np.bincount(model.observations.point[finite], minlength=len(model.points))
    total = np.bincount(model.observations.point[finite], weights=errors[finite], minlength=len(model.points))
    return np.where(count > 0, total / np.maximum(count, 1), -1.0)
