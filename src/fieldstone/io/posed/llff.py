"""LLFF `poses_bounds.npy`: 17 numbers a photo, photos in `images` or a smaller copy such as `images_8`, by name order.

The first 15 numbers are a 3x5 matrix: world_from_camera with axes down, right, back, then height, width and focal
length of the full photo; the last two are the depths of the nearest and the farthest thing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.opengl import MAX_DEVIATION
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.io.images.photos import PHOTO_SUFFIXES, read_photo_info
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.scene.photos import posed_photos, shared_cameras

FILE = "poses_bounds.npy"

OPENCV_FROM_LLFF_AXES = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Columns (down, right, back) times this are (right, down, forward)."""

CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 0.5))


def is_llff_folder(folder: Path) -> bool:
    """The folder has poses in the LLFF format."""
    return (folder / FILE).is_file()


def read_llff(folder: Path, photos: Path | None = None) -> PosedScene:
    """Photos with cameras. The points are those of the corners and the middle of each photo at its two depths.

    Args:
        photos: Where the photos are; None: `images`, or the largest smaller copy.

    Raises:
        InputError: The file is damaged, or there are not as many photos as poses.
    """
    path = folder / FILE
    rows = _read_rows(path)
    images = _images(photos or _photo_folder(folder), len(rows))
    cameras, poses, points = [], [], []
    for row, image in zip(rows, images, strict=True):
        matrix = row[:15].reshape(3, 5)
        height, width, focal = matrix[:, 4]
        near, far = row[15:]
        where = f"{path}, row {len(poses)} ({image.name})"
        R = matrix[:, :3] @ OPENCV_FROM_LLFF_AXES
        if np.abs(R.T @ R - np.eye(3)).max() > MAX_DEVIATION or np.linalg.det(R) < 0:
            raise InputError(f"{where}: its first 3x3 numbers are no rotation")
        if min(height, width, focal) <= 0 or not 0 < near < far:
            raise InputError(f"{where}: height, width, focal {matrix[:, 4]} and depths {row[15:]} are impossible")
        info = read_photo_info(image)
        sx, sy = info.width / width, info.height / height
        if abs(sx / sy - 1.0) > 0.02:
            raise InputError(
                f"{where}: the photo is {info.width}x{info.height}, the pose was made for {width:g}x{height:g}"
            )
        params = (focal * sx, focal * sy, 0.5 * info.width, 0.5 * info.height)
        cameras.append(Camera("PINHOLE", info.width, info.height, np.array(params)))
        world_from_cam = Rigid3(nearest_rotation(R), matrix[:, 3])
        poses.append(world_from_cam.inverse())
        fx, fy, cx, cy = params
        at_one = np.array([[(u * info.width - cx) / fx, (v * info.height - cy) / fy, 1.0] for u, v in CORNERS])
        points += [world_from_cam.apply(depth * at_one) for depth in (near, far)]
    names = [image.name for image in images]
    table = posed_photos(names, *shared_cameras(cameras), Rigid3.stack(poses), paths=images)
    return PosedScene(table, points_in_world=np.concatenate(points))


def _read_rows(path: Path) -> np.ndarray:
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a numpy array of numbers ({error}); copy it again") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        raise InputError(f"{path}: needs 17 numbers a photo, got {getattr(rows, 'shape', 'no array')}")
    if not len(rows):
        raise InputError(f"{path}: holds no pose")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, row {bad[0]}: not finite")
    return rows.astype(np.float64)


def _photo_folder(folder: Path) -> Path:
    """`images` if it is there, else the largest smaller copy."""

    def reduction(path: Path) -> int:
        word = path.name.removeprefix("images").removeprefix("_")
        return int(word) if word.isdecimal() else 1

    folders = [path for path in folder.iterdir() if path.is_dir() and path.name.split("_")[0] == "images"]
    if not folders:
        raise InputError(f"{folder}: no folder images, images_4, images_8 or the like beside {FILE}")
    return min(folders, key=reduction)


def _images(folder: Path, count: int) -> list[Path]:
    """Photos in name order."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of photos")
    images = sorted(p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith("."))
    if len(images) != count:
        raise InputError(
            f"{folder}: holds {len(images)} photos, but {FILE} has {count} poses; they are matched by name order, "
            "so none may be missing"
        )
    return images
