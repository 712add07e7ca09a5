"""COLMAP's text files: one record a line (images: two), `#` starts a comment line.

Tolerant in reading: names with blanks, padded exponents, any ids and order. Strict in writing: a name with blanks is
refused, because other readers cut it there.

Source:
    COLMAP's documentation, "Output Format".
"""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import numpy as np

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rotation import to_wxyz
from fieldstone.io.files.others import read_text
from fieldstone.io.models.colmap_tables import ColmapImage, ColmapTables, make_camera, make_image

MAX_ID = 2**63 - 1


def decode_text(folder: Path) -> ColmapTables:
    """Read cameras.txt, images.txt and points3D.txt.

    Raises:
        InputError: A line cannot be read; the message names file and line.
    """
    cameras = _read_cameras(folder / "cameras.txt")
    images = _read_images(folder / "images.txt")
    return _read_points(folder / "points3D.txt", cameras, images)


def encode_text(tables: ColmapTables) -> dict[str, bytes]:
    """The five files by name; numbers are written so that they are read back exactly.

    Raises:
        InputError: A photo's name holds blanks.
    """
    for image in tables.images:
        if image.name.split() != [image.name]:
            raise InputError(f"{image.name!r} has blanks, which cut names in text models; write a binary model")
    lines = {
        "rigs.txt": [f"{i} 1 CAMERA {i}" for i in tables.cameras],
        "cameras.txt": [f"{i} {c.model} {c.width} {c.height} {_join(c.params)}" for i, c in tables.cameras.items()],
        "frames.txt": [
            f"{m.image_id} {m.camera_id} {_pose(m)} 1 CAMERA {m.camera_id} {m.image_id}" for m in tables.images
        ],
        "images.txt": [line for m in tables.images for line in _image_lines(m)],
        "points3D.txt": _point_lines(tables),
    }
    return {name: ("# Written by fieldstone\n" + "".join(f"{x}\n" for x in ls)).encode() for name, ls in lines.items()}


def _read_cameras(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for number, line in _records(path):
        words = line.split()
        if len(words) < 5:
            _refuse(path, number, "a camera needs id, model, width, height and parameters")
        camera_id, width, height = (_whole(words[k], path, number) for k in (0, 2, 3))
        if camera_id in cameras:
            _refuse(path, number, f"camera {camera_id} is there twice")
        try:
            cameras[camera_id] = make_camera(words[1], width, height, _floats(words[4:], path, number))
        except InputError:
            raise
        except ValueError as error:
            _refuse(path, number, f"camera {camera_id}: {error}")
    return cameras


def _read_images(path: Path) -> list[ColmapImage]:
    """Pairs of lines; the second holds the keypoints and is there even if it is empty."""
    images = []
    lines = iter(enumerate(_lines(path), start=1))
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10:
            _refuse(path, number, "an image needs id, quaternion, translation, camera id and name")
        _, keypoint_line = next(lines, (0, ""))
        triples = keypoint_line.split()
        if len(triples) % 3:
            _refuse(path, number + 1, f"keypoints are x, y and point id each, but the line has {len(triples)} numbers")
        pixels = np.stack([_floats(triples[k::3], path, number + 1) for k in (0, 1)], axis=1)
        point_id = _wholes(triples[2::3], path, number + 1)
        image_id, camera_id = (_whole(words[k], path, number) for k in (0, 8))
        pose = _floats(words[1:8], path, number)
        try:
            images.append(make_image(image_id, camera_id, words[9].rstrip(), pose, pixels, point_id))
        except ValueError as error:
            _refuse(path, number, f"image {image_id}: {error}")
    return images


def _read_points(path: Path, cameras: dict[int, Camera], images: list[ColmapImage]) -> ColmapTables:
    ids, numbers, tracks = [], [], []
    for number, line in _records(path):
        words = line.split()
        if len(words) < 8 or len(words) % 2:
            _refuse(path, number, "a point needs id, x y z, r g b, error, and pairs of image id and keypoint")
        ids.append(_whole(words[0], path, number))
        numbers.append(_floats(words[1:8], path, number))
        if np.any((numbers[-1][3:6] < 0) | (numbers[-1][3:6] > 255)):
            _refuse(path, number, "r g b must lie in 0..255")
        tracks.append(_wholes(words[8:], path, number).reshape(-1, 2))
    table = np.array(numbers).reshape(len(ids), 7)
    elements = np.concatenate([np.empty((0, 2), dtype=np.int64), *tracks])
    return ColmapTables(
        cameras=cameras,
        images=images,
        point_id=np.array(ids, dtype=np.int64),
        xyz=table[:, :3],
        rgb=table[:, 3:6].astype(np.uint8),
        error=table[:, 6],
        track_row=np.repeat(np.arange(len(ids)), [len(t) for t in tracks]),
        track_image=elements[:, 0],
        track_keypoint=elements[:, 1],
    )


def _lines(path: Path) -> list[str]:
    return read_text(path).replace("\r\n", "\n").split("\n")


def _records(path: Path) -> list[tuple[int, str]]:
    """Lines with content, numbered from 1."""
    return [(k, x) for k, x in enumerate(_lines(path), start=1) if x.strip() and not x.startswith("#")]


def _floats(words: list[str], path: Path, number: int) -> np.ndarray:
    try:
        values = np.array([float(w) for w in words])
    except ValueError as error:
        _refuse(path, number, f"not a number ({error})")
    return values


def _wholes(words: list[str], path: Path, number: int) -> np.ndarray:
    """Ids as signed numbers; 2^64 - 1 is -1."""
    try:
        values = [int(w) for w in words]
    except ValueError as error:
        _refuse(path, number, f"not a whole number ({str(error)[:80]})")
    values = [-1 if v == 2**64 - 1 else v for v in values]
    if any(not -1 <= v <= MAX_ID for v in values):
        _refuse(path, number, "an id is out of range")
    return np.array(values, dtype=np.int64)


def _whole(word: str, path: Path, number: int) -> int:
    return int(_wholes([word], path, number)[0])


def _join(values: np.ndarray) -> str:
    return " ".join(repr(x) for x in values.tolist())


def _pose(image: ColmapImage) -> str:
    return f"{_join(to_wxyz(image.cam_from_world.R))} {_join(image.cam_from_world.t)}"


def _image_lines(image: ColmapImage) -> tuple[str, str]:
    keypoints = (f"{x!r} {y!r} {i}" for (x, y), i in zip(image.pixels.tolist(), image.point_id.tolist(), strict=True))
    return f"{image.image_id} {_pose(image)} {image.camera_id} {image.name}", " ".join(keypoints)


def _point_lines(tables: ColmapTables) -> list[str]:
    order = np.argsort(tables.track_row, kind="stable")
    elements = np.stack([tables.track_image, tables.track_keypoint], axis=1)[order]
    ends = np.cumsum(np.bincount(tables.track_row, minlength=len(tables.point_id)))
    tracks = np.split(elements, ends[:-1]) if len(ends) else []
    return [
        f"{tables.point_id[k]} {_join(tables.xyz[k])} {' '.join(map(str, tables.rgb[k].tolist()))} "
        f"{float(tables.error[k])!r} {' '.join(map(str, track.ravel().tolist()))}".rstrip()
        for k, track in enumerate(tracks)
    ]


def _refuse(path: Path, number: int, why: str) -> NoReturn:
    raise InputError(f"{path}, line {number}: {why}")
