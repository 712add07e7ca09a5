"""What is known of the cameras of photos before they are mapped: from the user, from EXIF, or by a vote of pairs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.features.verification import MAX_VOTING_PAIRS, calibrate_from_pairs
from fieldstone.geometry.camera import Camera, turned
from fieldstone.io.images.photos import PhotoInfo
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.robust.focal_voting import FocalVote

logger = logging.getLogger(__name__)

GUESSED_FOCAL = 1.2
"""Focal length over the longer side where nothing else is known of it."""
EARTH_RADIUS_M = 6.371e6
MIN_VOTE_CONTRAST = 0.1
"""A vote on the focal length that is flatter than this says nothing."""
PAIRS_TO_CHECK_EXIF = 30
MIN_CONTRAST_AGAINST_EXIF = 0.3
MAX_EXIF_ERROR = 2.0
"""EXIF is off by a tenth now and then; off by this factor it belongs to another lens or crop."""

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


def cameras_of_photos(
    infos: Sequence[PhotoInfo], options: MatchingOptions
) -> tuple[tuple[Camera, ...], Int[np.ndarray, "n"], list[str]]:
    """Cameras, the camera of each photo, and where each camera's focal length comes from: given, exif or guess.

    Photos of one size, EXIF camera, EXIF focal length and orientation share a camera.
    """
    cameras: list[Camera] = []
    source: list[str] = []
    index: dict[tuple, int] = {}
    camera_of_image = np.empty(len(infos), dtype=np.int64)
    for k, info in enumerate(infos):
        exif = (None, None) if options.single_camera else (info.exif.camera, info.exif.focal_px)
        # The camera held upside down has its principal point on the other side.
        key = (info.width, info.height, info.orientation, *exif)
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
    return tuple(cameras), camera_of_image, source


def vote_on_focal(
    graph: MatchGraph,
    cameras: tuple[Camera, ...],
    camera_of_image: Int[np.ndarray, "n"],
    source: list[str],
    options: MatchingOptions,
    seed: int,
) -> tuple[tuple[Camera, ...], list[str]]:
    """Cameras without a known focal length get the one that the pairs among their photos vote for, and so do those
    whose EXIF the pairs clearly contradict.

    Returns:
        The cameras, and one line on every focal length that is not what EXIF says.
    """
    out, notes = list(cameras), []

    def vote_of(c: int, max_pairs: int) -> FocalVote | None:
        images = camera_of_image == c
        return calibrate_from_pairs(graph, cameras[c], images, options.two_view, seed, options.threads, max_pairs)

    for c, camera in enumerate(cameras):
        longer = max(camera.width, camera.height)
        stated = float(camera.params[0]) / longer
        if source[c] == "guess":
            vote = vote_of(c, MAX_VOTING_PAIRS)
            if vote is None or vote.contrast < MIN_VOTE_CONTRAST:
                notes.append(
                    f"focal length unknown, and the photos do not tell it: {stated:.2f} times the longer side, guessed"
                )
                continue
        elif source[c] == "exif":
            vote = vote_of(c, PAIRS_TO_CHECK_EXIF)
            if vote is None or not contradicts(vote, camera):
                continue
            notes.append(
                f"EXIF states a focal length of {stated:.2f} times the longer side, the photos agree on "
                f"{vote.ratio:.2f}: EXIF is not used"
            )
        else:
            continue
        logger.info("focal length by vote: %.1f px, contrast %.2f", vote.ratio * longer, vote.contrast)
        out[c] = replace(camera, params=np.array([vote.ratio * longer, *camera.principal_point]))
    for note in notes:
        logger.warning("%s", note)
    return tuple(out), notes


def contradicts(vote: FocalVote, camera: Camera) -> bool:
    """Whether a vote is so clear, and so far from the camera's focal length, that the latter must be wrong."""
    factor = vote.ratio * max(camera.width, camera.height) / float(camera.params[0])
    return vote.contrast >= MIN_CONTRAST_AGAINST_EXIF and not 1.0 / MAX_EXIF_ERROR < factor < MAX_EXIF_ERROR


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
