"""COLMAP's binary files: little endian, counts of 64 bits, one record after another.

Source:
    COLMAP's documentation, "Output Format", and `sensor/models.h` for the numbers of the camera models.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.camera_models import CAMERA_MODELS
from fieldstone.geometry.rotation import to_wxyz
from fieldstone.io.files.binary import read_array, read_count, read_struct, refuse_at
from fieldstone.io.files.names import MAX_NAME_BYTES
from fieldstone.io.models.colmap_tables import (
    COLMAP_MODEL_NAMES,
    ColmapImage,
    ColmapTables,
    make_camera,
    make_image,
)

COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
TRACK_ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
RIG = struct.Struct("<IIiI")
FRAME = struct.Struct("<II7dIiIQ")
CAMERA_SENSOR = 0


def decode_binary(folder: Path) -> ColmapTables:
    """Read cameras.bin, images.bin and points3D.bin.

    Raises:
        InputError: A file is truncated or damaged; the message names file and byte.
    """
    cameras = _read_cameras(folder / "cameras.bin")
    images = _read_images(folder / "images.bin")
    return _read_points(folder / "points3D.bin", cameras, images)


def encode_binary(tables: ColmapTables) -> dict[str, bytes]:
    """The five files by name; rigs and frames are trivial: one rig per camera, one frame per image."""
    return {
        "rigs.bin": _counted([RIG.pack(i, 1, CAMERA_SENSOR, i) for i in tables.cameras]),
        "cameras.bin": _counted([_camera_bytes(i, camera) for i, camera in tables.cameras.items()]),
        "frames.bin": _counted([_frame_bytes(image) for image in tables.images]),
        "images.bin": _counted([_image_bytes(image) for image in tables.images]),
        "points3D.bin": _points_bytes(tables),
    }


def _read_cameras(path: Path) -> dict[int, Camera]:
    file = io.BytesIO(path.read_bytes())
    cameras: dict[int, Camera] = {}
    for _ in range(read_count(file, COUNT, CAMERA.size, path, "cameras")):
        start = file.tell()
        camera_id, model_id, width, height = read_struct(file, CAMERA, path, "a camera")
        if not 0 <= model_id < len(COLMAP_MODEL_NAMES):
            refuse_at(path, start, f"camera {camera_id} has the unknown model number {model_id}")
        name = COLMAP_MODEL_NAMES[model_id]
        num_params = CAMERA_MODELS[name].num_params if name in CAMERA_MODELS else 0
        params = read_array(file, np.dtype("<f8"), num_params, path, "camera parameters")
        if camera_id in cameras:
            refuse_at(path, start, f"camera {camera_id} is there twice")
        try:
            cameras[camera_id] = make_camera(name, width, height, params)
        except ValueError as error:
            refuse_at(path, start, f"camera {camera_id}: {error}")
    return cameras


def _read_images(path: Path) -> list[ColmapImage]:
    file = io.BytesIO(path.read_bytes())
    images = []
    for _ in range(read_count(file, COUNT, IMAGE.size + 1 + COUNT.size, path, "images")):
        start = file.tell()
        image_id, *pose, camera_id = read_struct(file, IMAGE, path, "an image")
        name = _read_name(file, path)
        num_keypoints = read_count(file, COUNT, KEYPOINT.itemsize, path, "keypoints")
        keypoints = read_array(file, KEYPOINT, num_keypoints, path, "keypoints")
        try:
            image = make_image(image_id, camera_id, name, np.array(pose), keypoints["xy"], keypoints["point_id"])
        except ValueError as error:
            refuse_at(path, start, f"image {image_id}: {error}")
        images.append(image)
    return images


def _read_name(file: io.BytesIO, path: Path) -> str:
    """Bytes up to NUL, of which a damaged file may have none."""
    start = file.tell()
    raw, end, _ = file.read(MAX_NAME_BYTES + 1).partition(b"\0")
    if not end:
        refuse_at(path, start, f"a name does not end within {MAX_NAME_BYTES} bytes; the file is damaged")
    file.seek(start + len(raw) + 1)
    try:
        return raw.decode()
    except UnicodeDecodeError:
        refuse_at(path, start, f"the name {raw[:40]!r} is not UTF-8")


def _read_points(path: Path, cameras: dict[int, Camera], images: list[ColmapImage]) -> ColmapTables:
    """Points have tracks of different lengths: their places are found first, then all fields are gathered at once."""
    data = path.read_bytes()
    count = read_count(io.BytesIO(data), COUNT, POINT.itemsize, path, "points")
    starts = np.empty(count, dtype=np.int64)
    position = COUNT.size
    length_at = POINT.itemsize - COUNT.size
    for k in range(count):
        starts[k] = position
        if position + POINT.itemsize > len(data):
            refuse_at(path, position, f"the file ends inside point {k} of {count}; it is truncated")
        (length,) = COUNT.unpack_from(data, position + length_at)
        position += POINT.itemsize + length * TRACK_ELEMENT.itemsize
        if position > len(data):
            refuse_at(path, int(starts[k]), f"a track of {length} keypoints does not fit into the rest of the file")
    raw = np.frombuffer(data, dtype=np.uint8)
    points = np.ascontiguousarray(raw[starts[:, None] + np.arange(POINT.itemsize)]).view(POINT).reshape(count)
    lengths = points["length"].astype(np.int64)
    row = np.repeat(np.arange(count), lengths)
    within = np.arange(len(row)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    element = starts[row] + POINT.itemsize + within * TRACK_ELEMENT.itemsize
    gathered = np.ascontiguousarray(raw[element[:, None] + np.arange(TRACK_ELEMENT.itemsize)])
    track = gathered.view(TRACK_ELEMENT).reshape(len(row))
    return ColmapTables(
        cameras=cameras,
        images=images,
        point_id=points["id"].astype(np.int64),
        xyz=points["xyz"].astype(np.float64),
        rgb=points["rgb"].copy(),
        error=points["error"].astype(np.float64),
        track_row=row,
        track_image=track["image"].astype(np.int64),
        track_keypoint=track["keypoint"].astype(np.int64),
    )


def _counted(records: list[bytes]) -> bytes:
    return COUNT.pack(len(records)) + b"".join(records)


def _camera_bytes(camera_id: int, camera: Camera) -> bytes:
    head = CAMERA.pack(camera_id, camera.spec.colmap_id, camera.width, camera.height)
    return head + camera.params.astype("<f8").tobytes()


def _image_bytes(image: ColmapImage) -> bytes:
    pose = image.cam_from_world
    keypoints = np.empty(len(image.pixels), KEYPOINT)
    keypoints["xy"], keypoints["point_id"] = image.pixels, image.point_id
    head = IMAGE.pack(image.image_id, *to_wxyz(pose.R), *pose.t, image.camera_id)
    return head + image.name.encode() + b"\0" + COUNT.pack(len(keypoints)) + keypoints.tobytes()


def _frame_bytes(image: ColmapImage) -> bytes:
    pose = image.cam_from_world
    data_ids = (1, CAMERA_SENSOR, image.camera_id, image.image_id)
    return FRAME.pack(image.image_id, image.camera_id, *to_wxyz(pose.R), *pose.t, *data_ids)


def _points_bytes(tables: ColmapTables) -> bytes:
    count = len(tables.point_id)
    points = np.empty(count, POINT)
    lengths = np.bincount(tables.track_row, minlength=count)
    points["id"], points["xyz"], points["rgb"] = tables.point_id, tables.xyz, tables.rgb
    points["error"], points["length"] = tables.error, lengths
    order = np.argsort(tables.track_row, kind="stable")
    track = np.empty(len(order), TRACK_ELEMENT)
    track["image"], track["keypoint"] = tables.track_image[order], tables.track_keypoint[order]
    point_bytes, track_bytes = points.tobytes(), track.tobytes()
    ends = np.cumsum(lengths) * TRACK_ELEMENT.itemsize
    parts = [COUNT.pack(count)]
    for k in range(count):
        parts.append(point_bytes[k * POINT.itemsize : (k + 1) * POINT.itemsize])
        parts.append(track_bytes[int(ends[k]) - int(lengths[k]) * TRACK_ELEMENT.itemsize : int(ends[k])])
    return b"".join(parts)
