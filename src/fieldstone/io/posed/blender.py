"""Blender scenes: `transforms_{train,val,test}.json` with exact poses, and images of one size with alpha.

`camera_angle_x` is the horizontal field of view in radians; `transform_matrix` is world_from_camera with OpenGL axes
(x right, y up, looking along -z); `file_path` has no `.png`. See docs/conventions.md.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.names import name_problem
from fieldstone.io.files.others import camera_pose, finite_number, read_json
from fieldstone.io.images.photos import PHOTO_SUFFIXES, PhotoProblem, read_photo_info
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.scene.photos import posed_photos

logger = logging.getLogger(__name__)

SPLITS = ("train", "val", "test")
NEAR, FAR = 2.0, 6.0
"""Range of the rays of these scenes, in scene units: objects within 1.5 of the origin, cameras 4 away."""


class _Frame(NamedTuple):
    """One image of a split: its name (the file's, without folder and suffix), file and pose."""

    name: str
    path: Path
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class _Split:
    """What one JSON file says, before any image is looked for."""

    path: Path
    angle_x: float
    frames: tuple[_Frame, ...]


def is_blender_folder(folder: Path) -> bool:
    """The folder has the JSON file of training views, so it is meant to be read by this module."""
    return (folder / "transforms_train.json").is_file()


def read_blender(folder: Path) -> PosedScene:
    """Read poses and find images; photos in the order of the files, train before val before test.

    An image that is missing is reported and left out. A missing `transforms_val.json` or `transforms_test.json` is a
    scene without that split.

    Raises:
        InputError: `transforms_train.json` is missing, a file is damaged, a pose is not finite or not rigid (the
            message names the frame), no training image is there, or images differ in size or field of view.
    """
    if not is_blender_folder(folder):
        raise InputError(f"{folder / 'transforms_train.json'}: no such file; give a folder in the Blender format")
    described = {s: _described(p, folder) for s in SPLITS if (p := folder / f"transforms_{s}.json").is_file()}
    frames: list[_Frame] = []
    splits: dict[str, Int[np.ndarray, "_"]] = {}
    sizes: dict[tuple[int, int], _Frame] = {}
    problems: list[PhotoProblem] = []
    for name, split in described.items():
        found = _frames_with_images(split, sizes, problems)
        splits[name] = np.arange(len(frames), len(frames) + len(found))
        frames += found
    if not len(splits["train"]):
        given = len(described["train"].frames)
        raise InputError(
            f"{described['train'].path}: none of its {given} images is there"
            + (f" (the first: {problems[0].path})" if problems else "")
            + "; copy the images beside it"
        )
    if len(sizes) > 1:
        (a, first), (b, second) = list(sizes.items())[:2]
        raise InputError(
            f"{second.path}: {b[0]} x {b[1]} pixels, but {first.path.name} has {a[0]} x {a[1]}; use images of one size"
        )
    photos = posed_photos(
        [frame.name for frame in frames],
        [_camera(described, *next(iter(sizes)))],
        np.zeros(len(frames), dtype=np.int64),
        Rigid3.stack([frame.cam_from_world for frame in frames]),
        paths=[frame.path for frame in frames],
    )
    return PosedScene(photos, splits, depth_range=(NEAR, FAR), problems=tuple(problems))


def _frames_with_images(
    split: _Split, sizes: dict[tuple[int, int], _Frame], problems: list[PhotoProblem]
) -> list[_Frame]:
    """The frames whose images can be opened; `sizes` gets the first frame of each size, `problems` the others."""
    found = []
    for frame in split.frames:
        try:
            info = read_photo_info(frame.path)
        except InputError as error:
            problems.append(PhotoProblem(frame.path, str(error)))
            continue
        sizes.setdefault((info.width, info.height), frame)
        found.append(frame)
    if len(found) < len(split.frames):
        missing = len(split.frames) - len(found)
        logger.warning("%s: %d of %d images are missing or unreadable", split.path, missing, len(split.frames))
    return found


def _camera(described: Mapping[str, _Split], width: int, height: int) -> Camera:
    """f = w / (2 tan(angle / 2)), principal point in the middle, the same for all splits."""
    train = described["train"]
    for split in described.values():
        if abs(split.angle_x - train.angle_x) > 1e-6:
            raise InputError(
                f"{split.path}: camera_angle_x is {split.angle_x:g}, but {train.angle_x:g} in {train.path.name}; "
                "use one camera for all splits"
            )
    focal = 0.5 * width / math.tan(0.5 * train.angle_x)
    return Camera("SIMPLE_PINHOLE", width, height, np.array([focal, 0.5 * width, 0.5 * height]))


def _described(path: Path, folder: Path) -> _Split:
    """Field of view and frames of one file."""
    value = read_json(path)
    if not isinstance(value, dict) or not isinstance(value.get("frames"), list):
        raise InputError(f"{path}: no list `frames`; is it in the Blender format?")
    angle = finite_number(value.get("camera_angle_x"), f"{path}: camera_angle_x")
    if not 0 < angle < math.pi:
        raise InputError(f"{path}: camera_angle_x must be an angle between 0 and pi radians, got {angle:g}")
    frames = tuple(_frame(path, folder, k, entry) for k, entry in enumerate(value["frames"]))
    seen: dict[str, int] = {}
    for k, frame in enumerate(frames):
        if frame.name in seen:
            raise InputError(f"{path}: frames {seen[frame.name]} and {k} are both named {frame.name}; remove one")
        seen[frame.name] = k
    return _Split(path, angle, frames)


def _frame(path: Path, folder: Path, index: int, entry: Any) -> _Frame:
    file_path = entry.get("file_path") if isinstance(entry, dict) else None
    if not isinstance(file_path, str):
        raise InputError(f"{path}, frame {index}: no file_path")
    relative = file_path.replace("\\", "/").removeprefix("./")
    if problem := name_problem(relative):
        raise InputError(f"{path}, frame {index}: {problem}")
    image = folder / relative
    if image.suffix.lower() not in PHOTO_SUFFIXES:
        image = image.with_name(image.name + ".png")
    where = f"{path}, frame {index} ({relative}): transform_matrix"
    return _Frame(image.stem, image, camera_pose(entry.get("transform_matrix"), where))
