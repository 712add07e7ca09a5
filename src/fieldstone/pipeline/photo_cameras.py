"""What is known of the cameras of photos before they are mapped: from the user, from EXIF, or by a vote of pairs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.features.verification import calibrate_from_pairs
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.io.photos import PhotoInfo
from fieldstone.pipeline.matching_options import MatchingOptions
from fieldstone.scene.match_graph import MatchGraph

logger = logging.getLogger(__name__)

GUESSED_FOCAL = 1.2
"""Focal length over the longer side where nothing else is known of it."""
EARTH_RADIUS_M = 6.371e6
MIN_VOTE_CONTRAST = 0.1
"""A vote on the focal length that is flatter than this says nothing."""


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


def cameras_of_photos(
    infos: Sequence[PhotoInfo], options: MatchingOptions
) -> tuple[tuple[Camera, ...], Int[np.ndarray, "n"], list[str]]:
    """Cameras, the camera of each photo, and where each camera's focal length comes from: given, exif or guess.

    Photos of one size, EXIF camera and EXIF focal length share a camera.
    """
    cameras: list[Camera] = []
    source: list[str] = []
    index: dict[tuple, int] = {}
    camera_of_image = np.empty(len(infos), dtype=np.int64)
    for k, info in enumerate(infos):
        exif = (None, None) if options.single_camera else (info.exif.camera, info.exif.focal_px)
        key = (info.width, info.height, *exif)
        if key not in index:
            index[key] = len(cameras)
            if options.intrinsics is not None:
                cameras.append(_given_camera(options, info.width, info.height))
                source.append("given")
            else:
                focal = info.exif.focal_px or GUESSED_FOCAL * max(info.width, info.height)
                params = np.array([focal, info.width / 2, info.height / 2])
                cameras.append(Camera("SIMPLE_PINHOLE", info.width, info.height, params))
                source.append("exif" if info.exif.focal_px else "guess")
        camera_of_image[k] = index[key]
    return tuple(cameras), camera_of_image, source


def vote_on_unknown(
    graph: MatchGraph,
    cameras: tuple[Camera, ...],
    camera_of_image: Int[np.ndarray, "n"],
    source: list[str],
    options: MatchingOptions,
    seed: int,
) -> tuple[Camera, ...]:
    """Cameras without any known focal length get the one that the pairs among their photos vote for."""
    out = list(cameras)
    for c, camera in enumerate(cameras):
        if source[c] != "guess":
            continue
        vote = calibrate_from_pairs(graph, camera, camera_of_image == c, options.two_view, seed, options.threads)
        if vote is None or vote.contrast < MIN_VOTE_CONTRAST:
            logger.warning("focal length unknown, and the photos do not tell it: guessed %.0f px", camera.params[0])
            continue
        focal = vote.ratio * max(camera.width, camera.height)
        logger.info("focal length by vote: %.1f px, contrast %.2f", focal, vote.contrast)
        out[c] = replace(camera, params=np.array([focal, *camera.principal_point]))
    return tuple(out)


def _given_camera(options: MatchingOptions, width: int, height: int) -> Camera:
    """The camera of --intrinsics for a photo of this size."""
    assert options.intrinsics is not None
    values = np.array(options.intrinsics, dtype=np.float64)
    model = options.camera_model or ("SIMPLE_PINHOLE" if len(values) == 3 else "PINHOLE")
    try:
        return Camera(model, width, height, values)
    except ValueError as error:
        raise InputError(f"--intrinsics {','.join(map(str, options.intrinsics))}: {error}") from error


def reduced_camera(camera: Camera, max_image_size: int) -> Camera:
    """The camera of the photo as reduced for matching."""
    factor = min(1.0, max_image_size / max(camera.width, camera.height))
    return rescale(camera, max(round(camera.width * factor), 1), max(round(camera.height * factor), 1))
