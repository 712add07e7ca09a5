"""The photos of a reconstruction or of any other COLMAP model: its registered views whose files are there."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from fieldstone.errors import InputError
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import PhotoProblem
from fieldstone.io.models.colmap import read_colmap
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.scene.photos import posed_photos
from fieldstone.scene.reconstruction import Reconstruction

logger = logging.getLogger(__name__)


def read_model_photos(source: Path, photos: Path | None = None, *, taken_from: Path | None = None) -> PosedScene:
    """Photos with cameras and poses, the points, and the model itself.

    Args:
        photos: Folder with the photos; None: `images` beside the model, else `taken_from`, else beside the model.
        taken_from: Where the photos were when the model was made.

    Raises:
        InputError: No model, a damaged one, or none of its photos is there.
    """
    model = read_colmap(source)
    folder = photos or _photo_folder(source, model, taken_from)
    scene = photos_of_model(model, folder)
    if scene is None:
        raise InputError(
            f"{folder}: holds none of the {len(model.registered())} photos of the model; give their folder as `photos`"
        )
    for problem in scene.problems:
        logger.warning("skipped %s: %s", problem.path, problem.reason)
    return scene


def photos_of_model(model: Reconstruction, folder: Path) -> PosedScene | None:
    """The registered views of a model whose photos lie in a folder; None if there are none.

    The others are among the `problems`.
    """
    registered = model.registered().tolist()
    is_there = {i: (folder / model.views[i].name).is_file() for i in registered}
    problems = tuple(
        PhotoProblem(folder / model.views[i].name, "no such file") for i, there in is_there.items() if not there
    )
    found = [i for i, there in is_there.items() if there]
    if not found:
        return None
    names = [model.views[i].name for i in found]
    table = posed_photos(
        names,
        model.cameras,
        np.array([model.views[i].camera for i in found], dtype=np.int64),
        Rigid3.stack([model.pose_of(i) for i in found]),
        paths=[folder / name for name in names],
    )
    return PosedScene(
        table,
        points_in_world=model.points.xyz,
        model=model,
        view_of_photo=np.array(found, dtype=np.int64),
        problems=problems,
    )


def _photo_folder(source: Path, model: Reconstruction, taken_from: Path | None) -> Path:
    """Where the photos of a model lie."""
    candidates = [source / "images", *([] if taken_from is None else [taken_from]), source]
    names = [model.views[i].name for i in model.registered().tolist()]
    for folder in candidates:
        if any((folder / name).is_file() for name in names):
            return folder
    searched = ", ".join(str(candidate) for candidate in candidates)
    raise InputError(f"{source}: the photos of the model are in none of {searched}; give their folder as `photos`")
