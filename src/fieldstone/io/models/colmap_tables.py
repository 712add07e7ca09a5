"""A COLMAP model as its files hold it, with ids, before it becomes a `Reconstruction`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.camera_models import CAMERA_MODELS
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import from_wxyz
from fieldstone.io.files.names import name_problem

MAX_QUATERNION = 1e6
"""Files may hold quaternions that are not normalised, but not by so much."""
NO_POINT = -1
"""`point3D_id` of a keypoint that shows no point (2^64 - 1 in binary files, read as a signed number)."""
COLMAP_MODEL_NAMES = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
"""Names of COLMAP's camera models by their number in binary files."""


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One record of images.bin: pose, camera, name, and its keypoints with the id of the point that each shows."""

    image_id: int
    camera_id: int
    name: str
    cam_from_world: Rigid3
    pixels: Float[np.ndarray, "m 2"]
    point_id: Int[np.ndarray, "m"]


@dataclass(frozen=True, eq=False)
class ColmapTables:
    """All records; tracks are flat: element k says that keypoint `track_keypoint[k]` of the image with the id
    `track_image[k]` shows the point in row `track_row[k]` of the point arrays. error: mean, pixels; -1 if not known.
    """

    cameras: dict[int, Camera]
    images: list[ColmapImage]
    point_id: Int[np.ndarray, "p"]
    xyz: Float[np.ndarray, "p 3"]
    rgb: UInt8[np.ndarray, "p 3"]
    error: Float[np.ndarray, "p"]
    track_row: Int[np.ndarray, "t"]
    track_image: Int[np.ndarray, "t"]
    track_keypoint: Int[np.ndarray, "t"]


def make_camera(name: str, width: int, height: int, params: Float[np.ndarray, "k"]) -> Camera:
    """The camera of a record.

    Raises:
        ValueError: A model that fieldstone does not have, or values that make no camera.
    """
    if name not in CAMERA_MODELS and name in COLMAP_MODEL_NAMES:
        raise ValueError(f"camera model {name} is not supported (supported: {', '.join(CAMERA_MODELS)})")
    if not (0 < width < 2**31 and 0 < height < 2**31):
        raise ValueError(f"an image of {width} x {height} pixels cannot be")
    return Camera(name, width, height, params)


def make_image(
    image_id: int,
    camera_id: int,
    name: str,
    wxyz_t: Float[np.ndarray, "7"],
    pixels: Float[np.ndarray, "m 2"],
    point_id: Int[np.ndarray, "m"],
) -> ColmapImage:
    """The image of a record.

    Raises:
        ValueError: A pose or keypoint that is not finite, a zero quaternion, or a name that cannot be used.
    """
    if problem := name_problem(name):
        raise ValueError(problem)
    if not np.isfinite(wxyz_t).all():
        raise ValueError(f"the pose of {name} is not finite")
    if np.abs(wxyz_t[:4]).max() > MAX_QUATERNION:
        raise ValueError(f"the quaternion of {name} is no rotation: {wxyz_t[:4].tolist()}")
    if not np.isfinite(pixels).all():
        raise ValueError(f"keypoint {int(np.argmin(np.isfinite(pixels).all(axis=1)))} of {name} is not finite")
    pose = Rigid3(from_wxyz(wxyz_t[:4]), wxyz_t[4:])
    return ColmapImage(image_id, camera_id, name, pose, pixels, point_id)
