"""Blender scenes: `transforms_{train,val,test}.json` with exact poses, and images of one size with alpha.

`camera_angle_x` is the horizontal field of view in radians; `transform_matrix` is world_from_camera with OpenGL axes
(x right, y up, looking along -z); `file_path` has no `.png`. See docs/conventions.md.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.io.files.names import name_problem
from fieldstone.io.images.photos import PHOTO_SUFFIXES, PhotoProblem, read_photo_info
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.scene.photos import posed_photos

logger = logging.getLogger(__name__)

SPLITS = ("train", "val", "test")
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
MAX_DEVIATION = 1e-3
"""Of R^T R from the identity; files hold float32, which is far better."""
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
    described = {s: _read_json(p, folder) for s in SPLITS if (p := folder / f"transforms_{s}.json").is_file()}
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
    return _Frame(image.stem, image, _pose(f"{path}, frame {index} ({relative})", entry.get("transform_matrix")))


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
