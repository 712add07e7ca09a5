"""`transforms.json` of nerfstudio and of instant-ngp: poses, intrinsics and splits in one file.

`transform_matrix` is world_from_camera with OpenGL axes; intrinsics stand at the top or in a frame, which then counts
more. Pixels have their corner at (0, 0), as ours. The world is the one of the matrices: `applied_transform` says where
it came from and changes nothing, because `ply_file_path` is in the same world. See docs/conventions.md.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.names import name_problem
from fieldstone.io.files.others import camera_pose, finite_number, read_json
from fieldstone.io.images.photos import PHOTO_SUFFIXES, PhotoProblem, natural_key, read_photo_info
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.io.shapes.ply import read_points
from fieldstone.scene.photos import posed_photos, shared_cameras

logger = logging.getLogger(__name__)

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE",)

NGP_SCALE = 0.33
"""instant-ngp multiplies positions by this, unless the file says otherwise, and adds 0.5; its scene is a unit cube."""


def find_transforms(source: Path) -> Path | None:
    """The file that `source` is or holds; None if neither."""
    if source.is_file() and source.suffix.lower() == ".json":
        return source
    inside = source / "transforms.json"
    return inside if inside.is_file() else None


def read_transforms(path: Path) -> PosedScene:
    """Photos, split, points and box of a file; photos in natural order of their names.

    Frames whose image is missing are left out with a warning.

    Raises:
        InputError: Not such a file, a pose or an intrinsic is missing or impossible (the message names the frame), or
            no image is there.
    """
    top = _top_of(path)
    frames, missing = _frames(path, top)
    if missing:
        logger.warning("%s: %d of %d images are missing: %s", path, len(missing), len(top["frames"]), missing[0])
    if not frames:
        first = f" (the first: {missing[0]})" if missing else ""
        raise InputError(f"{path}: none of its {len(top['frames'])} images is there{first}; copy them beside it")
    frames.sort(key=lambda frame: natural_key(frame.name))
    photos = posed_photos(
        [frame.name for frame in frames],
        *shared_cameras([frame.camera for frame in frames]),
        Rigid3.stack([frame.cam_from_world for frame in frames]),
        paths=[frame.image for frame in frames],
        masks=[frame.mask for frame in frames],
    )
    problems = tuple(PhotoProblem(path.parent / name, "no such file") for name in missing)
    splits = _splits(path, top, [frame.file_path for frame in frames])
    return PosedScene(photos, splits, _points(path, top), _box(path, top), problems=problems)


class _Frame(NamedTuple):
    """One entry of `frames` whose image is there."""

    name: str
    file_path: str
    image: Path
    mask: Path | None
    camera: Camera
    cam_from_world: Rigid3


def _frames(path: Path, top: Mapping[str, Any]) -> tuple[list[_Frame], list[str]]:
    """The frames whose images are there, and the `file_path` of those whose images are not."""
    frames: dict[str, _Frame] = {}
    missing: list[str] = []
    for k, entry in enumerate(top["frames"]):
        where = f"{path}, frame {k}"
        file_path = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(file_path, str):
            raise InputError(f"{where}: no file_path")
        image = _image_path(where, path.parent, file_path)
        where = f"{where} ({file_path})"
        if image is None:
            missing.append(file_path)
            continue
        name = image.relative_to(path.parent).as_posix()
        if name in frames:
            raise InputError(f"{where}: the image {name} was named before; remove one of the two frames")
        camera, mask = _camera(where, {**top, **entry}, image), _mask_path(where, path.parent, entry)
        frames[name] = _Frame(
            name,
            file_path,
            image,
            mask,
            camera,
            camera_pose(entry.get("transform_matrix"), f"{where}: transform_matrix"),
        )
    return list(frames.values()), missing


def _points(path: Path, top: Mapping[str, Any]) -> Float[np.ndarray, "p 3"]:
    """The points that `ply_file_path` names."""
    if not top.get("ply_file_path"):
        return np.empty((0, 3))
    ply = path.parent / str(top["ply_file_path"])
    if name_problem(str(top["ply_file_path"])) is None and ply.is_file():
        return read_points(ply).xyz
    logger.warning("%s: its points %s are missing", path, top["ply_file_path"])
    return np.empty((0, 3))


def _top_of(path: Path) -> dict[str, Any]:
    value = read_json(path, comments=True)  # instant-ngp accepts them
    if not isinstance(value, dict) or not isinstance(value.get("frames"), list):
        raise InputError(f"{path}: no list `frames`; is it a transforms.json?")
    return value


def _image_path(where: str, folder: Path, file_path: str) -> Path | None:
    """The image of a frame, with the suffix that the file may have left out."""
    relative = file_path.replace("\\", "/").removeprefix("./")
    if problem := name_problem(relative):
        raise InputError(f"{where}: {problem}")
    image = folder / relative
    candidates = [image, *(image.with_name(image.name + suffix) for suffix in PHOTO_SUFFIXES)]
    return next((c for c in candidates if c.suffix.lower() in PHOTO_SUFFIXES and c.is_file()), None)


def _mask_path(where: str, folder: Path, entry: Mapping[str, Any]) -> Path | None:
    value = entry.get("mask_path")
    if value is None:
        return None
    if not isinstance(value, str) or name_problem(value.removeprefix("./")) is not None:
        raise InputError(f"{where}: mask_path {value!r} is no path below the folder")
    return folder / value.removeprefix("./")


def _camera(where: str, given: Mapping[str, Any], image: Path) -> Camera:
    """The camera of a frame."""
    info = read_photo_info(image)
    width = _number(where, given, "w", float(info.width))
    height = _number(where, given, "h", float(info.height))
    fx = _focal(where, given, "fl_x", "camera_angle_x", "x_fov", width)
    fy = _focal(where, given, "fl_y", "camera_angle_y", "y_fov", height) or fx
    fx = fx or fy
    if not fx or not fy:
        raise InputError(f"{where}: no focal length; needs fl_x, camera_angle_x or x_fov")
    cx, cy = _number(where, given, "cx", 0.5 * width), _number(where, given, "cy", 0.5 * height)
    model, coefficients = _distortion(where, given)
    # The image may be a smaller copy: each axis scales by its own factor.
    sx, sy = info.width / width, info.height / height
    if abs(sx / sy - 1.0) > 0.02:
        raise InputError(f"{where}: the image is {info.width}x{info.height}, but w and h say {width:g}x{height:g}")
    params = (fx * sx, fy * sy, cx * sx, cy * sy, *coefficients)
    return Camera(model, info.width, info.height, np.array(params))


def _focal(where: str, given: Mapping[str, Any], name: str, radians: str, degrees: str, size: float) -> float | None:
    """Focal length in pixels; None if the file has none for this axis."""
    focal = _number(where, given, name, None)
    if focal is None:
        angle = _number(where, given, radians, None)
        if angle is None and (in_degrees := _number(where, given, degrees, None)) is not None:
            angle = math.radians(in_degrees)
        if angle is None:
            return None
        if not 0 < angle < math.pi:
            raise InputError(f"{where}: {radians} must lie between 0 and pi, got {angle:g}")
        focal = 0.5 * size / math.tan(0.5 * angle)
    if focal <= 0:
        raise InputError(f"{where}: {name} must be positive, got {focal:g}")
    return focal


def _distortion(where: str, given: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Camera model and its coefficients; `distortion_params` are k1, k2, k3, k4, p1, p2."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    listed = given.get("distortion_params")
    if listed is not None:
        if not isinstance(listed, Sequence) or len(listed) != len(names):
            raise InputError(f"{where}: distortion_params must be the six numbers {', '.join(names)}")
        given = dict(zip(names, listed, strict=True)) | {key: given[key] for key in ("camera_model",) if key in given}
    k1, k2, k3, k4, p1, p2 = (float(_number(where, given, name, 0.0) or 0.0) for name in names)
    model = given.get("camera_model", "OPENCV_FISHEYE" if given.get("is_fisheye") else "OPENCV")
    if model in FISHEYE:
        return "OPENCV_FISHEYE", (k1, k2, k3, k4)
    if model not in PERSPECTIVE:
        raise InputError(f"{where}: camera model {model!r} cannot be used; needs OPENCV, OPENCV_FISHEYE or PINHOLE")
    if k3 or k4:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, k4, 0.0, 0.0)
    if k1 or k2 or p1 or p2:
        return "OPENCV", (k1, k2, p1, p2)
    return "PINHOLE", ()


def _number(where: str, given: Mapping[str, Any], name: str, default: float | None) -> Any:
    value = given.get(name, default)
    return value if value is default else finite_number(value, f"{where}: {name}")


def _splits(path: Path, top: Mapping[str, Any], file_paths: Sequence[str]) -> dict[str, Int[np.ndarray, "_"]]:
    """By `train_filenames`, `test_filenames` and `val_filenames`, if the file has them."""
    lists = {key: top.get(f"{key}_filenames") for key in ("train", "test", "val")}
    if not any(lists.values()):
        return {}
    held_out = set(lists["test"] or lists["val"] or ())
    train = set(lists["train"] or ())
    trained = [name in train if train else name not in held_out for name in file_paths]
    if not any(trained):
        raise InputError(f"{path}: train_filenames names none of the images that are there")
    return {"train": np.flatnonzero(trained), "test": np.flatnonzero([name in held_out for name in file_paths])}


def _box(path: Path, top: Mapping[str, Any]) -> Float[np.ndarray, "2 3"] | None:
    """The unit cube of instant-ngp in the world of the file; None where `aabb_scale` says that there is more."""
    if top.get("aabb_scale") != 1:
        return None
    scale = float(_number(str(path), top, "scale", NGP_SCALE) or NGP_SCALE)
    offset = np.array(top.get("offset", [0.5, 0.5, 0.5]), dtype=np.float64)
    if offset.shape != (3,) or not np.isfinite(offset).all() or scale <= 0:
        raise InputError(f"{path}: scale and offset must be a positive number and three numbers")
    return np.stack([(0.0 - offset) / scale, (1.0 - offset) / scale])
