"""Blender scenes: `transforms_{train,val,test}.json` with exact poses, and images of one size with alpha.

`camera_angle_x` is the horizontal field of view in radians; `transform_matrix` is world_from_camera with OpenGL axes
(x right, y up, looking along -z); `file_path` has no `.png`. See docs/conventions.md.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.io.files.names import name_problem
from fieldstone.io.images.photos import PHOTO_SUFFIXES, Photo, PhotoProblem, read_photo, read_photo_info

logger = logging.getLogger(__name__)

SPLITS = ("train", "val", "test")
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
MAX_DEVIATION = 1e-3
"""Of R^T R from the identity; files hold float32, which is far better."""
NEAR, FAR = 2.0, 6.0
"""Range of the rays of these scenes, in scene units: objects within 1.5 of the origin, cameras 4 away."""


@dataclass(frozen=True, eq=False)
class BlenderFrame:
    """One image of a split: its name (the file's, without folder and suffix), file and pose."""

    name: str
    path: Path
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class BlenderScene:
    """A scene as its files describe it; frames in the order of the files, those without an image left out."""

    camera: Camera
    splits: Mapping[str, tuple[BlenderFrame, ...]]
    problems: tuple[PhotoProblem, ...]
    """Images that a JSON file names and that are missing or no images."""
    near: float = NEAR
    far: float = FAR


@dataclass(frozen=True, eq=False)
class _Split:
    """What one JSON file says, before any image is looked for."""

    path: Path
    angle_x: float
    frames: tuple[BlenderFrame, ...]


def is_blender_folder(folder: Path) -> bool:
    """The folder has the JSON file of training views, so it is meant to be read by this module."""
    return (folder / "transforms_train.json").is_file()


def read_blender(folder: Path) -> BlenderScene:
    """Read poses and find images; `read_split` decodes them.

    An image that is missing is reported and left out. A missing `transforms_val.json` or `transforms_test.json` is a
    scene without that split.

    Raises:
        InputError: `transforms_train.json` is missing, a file is damaged, a pose is not finite or not rigid (the
            message names the frame), no training image is there, or images differ in size or field of view.
    """
    if not is_blender_folder(folder):
        raise InputError(f"{folder / 'transforms_train.json'}: no such file; give a folder in the Blender format")
    described = {s: _read_json(p, folder) for s in SPLITS if (p := folder / f"transforms_{s}.json").is_file()}
    splits: dict[str, tuple[BlenderFrame, ...]] = {}
    sizes: dict[tuple[int, int], BlenderFrame] = {}
    problems: list[PhotoProblem] = []
    for name, split in described.items():
        found = []
        for frame in split.frames:
            try:
                info = read_photo_info(frame.path)
            except InputError as error:
                problems.append(PhotoProblem(frame.path, str(error)))
                continue
            sizes.setdefault((info.width, info.height), frame)
            found.append(frame)
        splits[name] = tuple(found)
        if len(found) < len(split.frames):
            missing = len(split.frames) - len(found)
            logger.warning("%s: %d of %d images are missing or unreadable", split.path, missing, len(split.frames))
    if not splits["train"]:
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
    return BlenderScene(_camera(described, *next(iter(sizes))), splits, tuple(problems))


def read_split(scene: BlenderScene, split: str) -> tuple[list[tuple[BlenderFrame, Photo]], list[PhotoProblem]]:
    """Decode the images of a split; those that are damaged are reported and left out.

    Raises:
        InputError: The scene has no such split, or none of its images can be read.
    """
    frames = scene.splits.get(split, ())
    if not frames:
        raise InputError(f"the scene has no {split} images; it has {', '.join(s for s in scene.splits)}")
    read: list[tuple[BlenderFrame, Photo]] = []
    problems: list[PhotoProblem] = []
    with ThreadPoolExecutor() as pool:
        # Decoding leaves Python's lock; results are taken in the order of the frames.
        reading = [pool.submit(read_photo, frame.path) for frame in frames]
        for frame, photo in zip(frames, reading, strict=True):
            try:
                read.append((frame, photo.result()))
            except InputError as error:
                logger.warning("skipped %s", error)
                problems.append(PhotoProblem(frame.path, str(error)))
    if not read:
        raise InputError(f"none of {len(frames)} {split} images can be read; the first: {problems[0].reason}")
    return read, problems


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


def _read_json(path: Path, folder: Path) -> _Split:
    """Field of view and frames of one file."""
    try:
        value = json.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}, byte {error.start}: not UTF-8 text; copy it again") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}: not valid JSON ({error.msg}); copy it again") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: not valid JSON (nested too deeply, or a number too long)") from error
    if not isinstance(value, dict) or not isinstance(value.get("frames"), list):
        raise InputError(f"{path}: no list `frames`; is it in the Blender format?")
    angle = value.get("camera_angle_x")
    if isinstance(angle, bool) or not isinstance(angle, int | float) or not 0 < angle < math.pi:
        raise InputError(f"{path}: camera_angle_x must be an angle between 0 and pi radians, got {_short(angle)}")
    frames = tuple(_frame(path, folder, k, entry) for k, entry in enumerate(value["frames"]))
    seen: dict[str, int] = {}
    for k, frame in enumerate(frames):
        if frame.name in seen:
            raise InputError(f"{path}: frames {seen[frame.name]} and {k} are both named {frame.name}; remove one")
        seen[frame.name] = k
    return _Split(path, float(angle), frames)


def _frame(path: Path, folder: Path, index: int, entry: Any) -> BlenderFrame:
    file_path = entry.get("file_path") if isinstance(entry, dict) else None
    if not isinstance(file_path, str):
        raise InputError(f"{path}, frame {index}: no file_path")
    relative = file_path.replace("\\", "/").removeprefix("./")
    if problem := name_problem(relative):
        raise InputError(f"{path}, frame {index}: {problem}")
    image = folder / relative
    if image.suffix.lower() not in PHOTO_SUFFIXES:
        image = image.with_name(image.name + ".png")
    return BlenderFrame(image.stem, image, _pose(f"{path}, frame {index} ({relative})", entry.get("transform_matrix")))


def _pose(where: str, value: Any) -> Rigid3:
    """`cam_from_world` with our axes from a world_from_camera matrix with OpenGL axes."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: transform_matrix is no matrix of numbers") from error
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: transform_matrix must be 4x4, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: transform_matrix is not finite; remove the frame")
    if problem := _rigid_problem(matrix):
        raise InputError(f"{where}: transform_matrix is no rigid motion ({problem})")
    world_from_cam = Rigid3(nearest_rotation(matrix[:3, :3]) @ CV_FROM_GL, matrix[:3, 3])
    return world_from_cam.inverse()


def _rigid_problem(matrix: Float[np.ndarray, "4 4"]) -> str | None:
    R = matrix[:3, :3]
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > MAX_DEVIATION:
        return f"its last row is {matrix[3].tolist()}"
    if np.abs(R).max() > 2 or np.abs(R.T @ R - np.eye(3)).max() > MAX_DEVIATION:
        return "its columns are not orthonormal"
    if np.linalg.det(R) < 0:
        return "it mirrors"
    return None


def _short(value: Any) -> str:
    return repr(value)[:40]
