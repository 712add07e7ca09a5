"""What a mapper works on, from a folder: given matches, or photos with features and matches of our own."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.errors import InputError
from fieldstone.features.pairs import choose_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.io.files.cache import UnitCache
from fieldstone.io.given_matches.matching_txt import read_given_matches
from fieldstone.io.images.photos import PhotoProblem, list_photos, photo_name, read_photo
from fieldstone.mapping.model.calibration import FOCAL_SIGMA
from fieldstone.progress import OnProgress, silent
from fieldstone.report.figures import PhotoByName
from fieldstone.report.raster import DRAWN_PX
from fieldstone.run.matching.calibration import calibrate
from fieldstone.run.matching.detection import PANORAMA, DetectedPhoto, detect
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.pairs import match_pairs, verify
from fieldstone.run.matching.photo_cameras import cameras_of_photos, gps_positions
from fieldstone.run.matching.static import leave_out_static_content
from fieldstone.scene.match_graph import MatchGraph

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class MatchedPhotos:
    """A correspondence graph with cameras, and the photos behind it.

    Keypoints and cameras are in pixels of the upright photos, whatever size features were detected at.
    """

    graph: MatchGraph
    cameras: tuple[Camera, ...]
    camera_of_image: Int[np.ndarray, "n"]
    focal_sigma: Float[np.ndarray, "c"]
    """By what share the focal length of each camera may be off: a standard deviation; 0: its intrinsics are exact."""
    photo_of: PhotoByName
    problems: tuple[PhotoProblem, ...]
    seconds: Mapping[str, float]
    photos: tuple[DetectedPhoto, ...] = ()
    """Photos with their features; none where the matches were given."""
    sharpness: Mapping[str, float] = field(default_factory=dict)
    """Of photos by name, see `detection.sharpness`."""
    notes: Sequence[str] = ()
    """What a user should know of how the cameras were found."""

    @property
    def known(self) -> Bool[np.ndarray, "c"]:
        """Cameras whose intrinsics are exact."""
        return self.focal_sigma == 0.0


def read_matched_photos(folder: Path) -> MatchedPhotos:
    """Given matches and calibration, and the photos for colours and figures where they are there."""
    start = time.perf_counter()
    given = read_given_matches(folder)
    camera = given.camera
    return MatchedPhotos(
        graph=given.graph,
        cameras=(camera,),
        camera_of_image=np.zeros(given.graph.num_images, dtype=np.int64),
        focal_sigma=np.zeros(1),
        photo_of=photos_on_disk({path.name: path for path in given.photos if path is not None}),
        problems=given.problems,
        seconds={"reading": time.perf_counter() - start},
    )


def match_photos(
    folder: Path, options: MatchingOptions, seed: int, cache: UnitCache, on_progress: OnProgress = silent
) -> MatchedPhotos:
    """Features of every photo, matches of every pair, focal lengths where nobody knows them, two-view geometry.

    Raises:
        InputError: Fewer than two photos can be read, or most of them are panoramas.
    """
    stop, seconds = _stopwatch()
    paths = {photo_name(path, folder): path for path in list_photos(folder)}
    photos, problems = detect(paths, options, cache, on_progress)
    _refuse_panoramas(folder, problems, len(paths))
    for problem in problems:
        logger.warning("skipped %r: %s", photo_name(problem.path, folder), problem.reason)
    if len(photos) < 2:
        reasons = "".join(f"; {photo_name(problem.path, folder)}: {problem.reason}" for problem in problems[:3])
        raise InputError(
            f"{folder}: a reconstruction needs at least two different readable photos, found {len(photos)}{reasons}; "
            "add photos"
        )
    infos = [photo.info for photo in photos]
    stop("features")
    header = cameras_of_photos(infos, options)
    match = partial(_putative, options=options, seed=seed, cache=cache, on_progress=on_progress)
    of_photo = [header.cameras[c] for c in header.camera_of_image.tolist()]
    photos, graph, static_notes = leave_out_static_content(photos, match, of_photo, options, seed, cache)
    stop("matching")
    _, folder_of_photo = np.unique([str(info.path.parent) for info in infos], return_inverse=True)
    found, notes = calibrate(graph, header, folder_of_photo, options, seed)
    cameras, camera_of_image = found.cameras, found.camera_of_image
    graph = verify(graph, photos, cameras, camera_of_image, options, seed, cache, on_progress)
    stop("verification")
    exact = np.array([options.fix_intrinsics and source == "given" for source in found.source])
    photo_of = photos_on_disk({photo.name: photo.info.path for photo in photos})
    sharpness = {photo.name: photo.sharpness for photo in photos}
    return MatchedPhotos(
        graph,
        cameras,
        camera_of_image,
        np.where(exact, 0.0, np.minimum(found.focal_sigma, FOCAL_SIGMA)),
        photo_of,
        tuple(problems),
        seconds,
        tuple(photos),
        sharpness,
        [*static_notes, *notes],
    )


def _refuse_panoramas(folder: Path, problems: Sequence[PhotoProblem], num_files: int) -> None:
    """One line for all of them, where most photos are panoramas."""
    panoramas = sum(problem.reason == PANORAMA for problem in problems)
    if panoramas > num_files / 2:
        raise InputError(
            f"{folder}: {panoramas} of {num_files} photos are panoramas, as their XMP says, and there is no camera "
            "model for these: cut ordinary views out of them, or give ordinary photos"
        )


def _putative(
    photos: Sequence[DetectedPhoto], options: MatchingOptions, seed: int, cache: UnitCache, on_progress: OnProgress
) -> MatchGraph:
    """Putative matches of the pairs of photos that seem to show the same."""
    features = [photo.features for photo in photos]
    rng = np.random.default_rng([seed, len(features)])
    positions = gps_positions([photo.info for photo in photos])
    pairs = choose_pairs(features, options.pairs, rng, positions=positions, threads=options.threads)
    return match_pairs(photos, pairs, options, cache, on_progress)


def photos_on_disk(by_name: Mapping[str, Path]) -> PhotoByName:
    """Photos by name, decoded when they are asked for, no finer than figures need; the last few are kept."""

    @lru_cache(maxsize=8)
    def photo_of(name: str) -> np.ndarray | None:
        return read_photo(by_name[name], at_least_px=DRAWN_PX).rgb if name in by_name else None

    return photo_of


def _stopwatch() -> tuple[Callable[[str], None], dict[str, float]]:
    """`stop(stage)` notes the wall seconds since the last call; and the notes."""
    seconds: dict[str, float] = {}
    last = [time.perf_counter()]

    def stop(stage: str) -> None:
        now = time.perf_counter()
        seconds[stage] = now - last[0]
        last[0] = now

    return stop, seconds
