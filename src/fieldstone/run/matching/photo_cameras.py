"""What is known of the cameras of photos before they are matched: from the user, from EXIF, or nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera, turned
from fieldstone.io.images.photos import PhotoInfo
from fieldstone.run.matching.options import MatchingOptions

GUESSED_FOCAL = 1.2
"""Focal length over the longer side where nothing else is known of it."""
EARTH_RADIUS_M = 6.371e6
MIN_PHOTOS_OF_MANY, SHARE_OF_MANY = 4, 0.5
"""A set is of many cameras if of at least so many photos, more than this share name different ones."""

FocalSource = Literal["given", "exif", "guess", "photos"]
"""From the user, from EXIF, from nobody, or from the pairs among the photos."""

SIGMA_OF_SOURCE: dict[FocalSource, float] = {"given": np.inf, "exif": 0.05, "guess": 0.45, "photos": 0.45}
"""Relative standard deviations; given ones that are not exact are only a start. What pairs say is not counted twice."""

TURNED_UPRIGHT = {
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, -1), (1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, 1), (-1, 0)),
}
"""Where right and down of the stored pixels point in the upright photo, by EXIF orientation (1: right and down)."""


def gps_positions(infos: Sequence[PhotoInfo]) -> Float[np.ndarray, "n 3"] | None:
    """Metres east, north and up of the first GPS position, nan without one; None if no photo has any.

    A plane tangent to a sphere: close enough to find neighbours.
    """
    places = [info.exif.gps for info in infos]
    known = [gps for gps in places if gps is not None]
    if not known:
        return None
    origin = known[0]
    metres_per_degree = np.deg2rad(1.0) * EARTH_RADIUS_M
    east = metres_per_degree * np.cos(np.deg2rad(origin.latitude_deg))
    out = np.full((len(infos), 3), np.nan)
    for row, gps in zip(out, places, strict=True):
        if gps is not None:
            row[0] = (gps.longitude_deg - origin.longitude_deg) * east
            row[1] = (gps.latitude_deg - origin.latitude_deg) * metres_per_degree
            row[2] = gps.altitude_m or 0.0
    return out


@dataclass(frozen=True, eq=False)
class PhotoCameras:
    """Cameras, the camera of each photo, and what is known of each camera's focal length."""

    cameras: tuple[Camera, ...]
    camera_of_image: Int[np.ndarray, "n"]
    source: tuple[FocalSource, ...]
    """Where the focal length comes from."""

    @property
    def focal_sigma(self) -> Float[np.ndarray, "c"]:
        """By what share focal lengths from that source are off: standard deviations."""
        return np.array([SIGMA_OF_SOURCE[source] for source in self.source])


def cameras_of_photos(infos: Sequence[PhotoInfo], options: MatchingOptions) -> PhotoCameras:
    """What the headers of photos say of their cameras.

    Photos of one size and orientation share a camera as `options.cameras` says; left to itself, as EXIF does: one body,
    one lens and one setting of it. Photos without EXIF share one, unless those with it come from many cameras: then
    each has its own.
    """
    alone = options.cameras == "auto" and _are_of_many_cameras(infos)
    cameras: list[Camera] = []
    source: list[FocalSource] = []
    index: dict[tuple, int] = {}
    camera_of_image = np.empty(len(infos), dtype=np.int64)
    for k, info in enumerate(infos):
        exif = info.exif.camera, info.exif.lens, info.exif.focal_px
        unknown = exif == (None, None, None)
        of_whom = {
            "auto": (exif, k if alone and unknown else None),
            "one": None,
            "per-folder": info.path.parent,
            "per-photo": k,
        }[options.cameras]
        # The camera held upside down has its principal point on the other side.
        key = (info.width, info.height, info.orientation, of_whom)
        if key not in index:
            index[key] = len(cameras)
            if options.intrinsics is not None:
                cameras.append(_given_camera(options, info))
                source.append("given")
            else:
                focal = info.exif.focal_px or GUESSED_FOCAL * max(info.width, info.height)
                params = np.array([focal, info.width / 2, info.height / 2])
                cameras.append(Camera("SIMPLE_PINHOLE", info.width, info.height, params))
                source.append("exif" if info.exif.focal_px else "guess")
        camera_of_image[k] = index[key]
    return PhotoCameras(tuple(cameras), camera_of_image, tuple(source))


def _are_of_many_cameras(infos: Sequence[PhotoInfo]) -> bool:
    """Whether most photos that name their camera name different ones (or, if few do, most have sizes of their own):
    the photos of many people."""
    said: list = [info.exif.camera for info in infos if info.exif.camera is not None]
    if len(said) < MIN_PHOTOS_OF_MANY:
        said = [tuple(sorted((info.width, info.height))) for info in infos]
    return len(said) >= MIN_PHOTOS_OF_MANY and len(set(said)) > SHARE_OF_MANY * len(said)


def _given_camera(options: MatchingOptions, info: PhotoInfo) -> Camera:
    """The camera of given intrinsics, which speaks of stored pixels, for an upright photo."""
    assert options.intrinsics is not None
    values = np.array(options.intrinsics, dtype=np.float64)
    model = options.camera_model or ("SIMPLE_PINHOLE" if len(values) == 3 else "PINHOLE")
    turn = np.array(TURNED_UPRIGHT.get(info.orientation, ((1, 0), (0, 1))))
    width, height = np.abs(turn) @ [info.width, info.height]
    try:
        return turned(Camera(model, int(width), int(height), values), turn)
    except ValueError as error:
        raise InputError(f"`intrinsics` {','.join(map(str, options.intrinsics))}: {error}") from error
