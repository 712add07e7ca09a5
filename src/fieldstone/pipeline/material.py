"""What a mapper works on, from a folder: given matches, or photos with features and matches of our own."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.errors import InputError
from fieldstone.features.matching import MutualRatio
from fieldstone.features.pairs import PairOptions, choose_pairs
from fieldstone.features.sift import Sift, SiftOptions
from fieldstone.features.verification import calibrate_from_pairs, verify_pairs
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.io.matching_txt import read_course_folder
from fieldstone.io.photos import PhotoInfo, PhotoProblem, list_photos, read_photo
from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.solve.two_view import TwoViewOptions

logger = logging.getLogger(__name__)

GUESSED_FOCAL = 1.2
"""Focal length over the longer side where nothing else is known of it."""
EARTH_RADIUS_M = 6.371e6
MIN_VOTE_CONTRAST = 0.1
"""A vote on the focal length that is flatter than this says nothing."""

OnStage = Callable[[str], None]
PhotoByName = Callable[[str], UInt8[np.ndarray, "h w 3"] | None]
"""Decodes the photo of that name; None if there is none."""


@dataclass(frozen=True)
class MatchingOptions:
    """From photos to a verified graph."""

    sift: SiftOptions = field(default_factory=SiftOptions)
    max_ratio: float = 0.8
    """Ratio test of the matcher."""
    pairs: PairOptions = field(default_factory=PairOptions)
    """Which pairs of photos are matched."""
    two_view: TwoViewOptions = field(default_factory=TwoViewOptions)
    camera_model: str | None = None
    """Model of given intrinsics; None: PINHOLE for four numbers, SIMPLE_PINHOLE for three."""
    intrinsics: tuple[float, ...] | None = None
    """Parameters of the model, in pixels of the stored photo; None: from EXIF, or from the photos themselves."""
    fix_intrinsics: bool = False
    """Given intrinsics are exact."""
    single_camera: bool = False
    """All photos share one camera, whatever their EXIF says."""
    threads: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Results are the same for any number."""


@dataclass(frozen=True, eq=False)
class Material:
    """A graph, its cameras, and the photos behind it.

    The graph and the cameras are in working pixels: those of the photos as reduced for matching. `full_size` brings a
    reconstruction back to the pixels of the photos.
    """

    graph: MatchGraph
    cameras: tuple[Camera, ...]
    camera_of_image: Int[np.ndarray, "n"]
    known: Bool[np.ndarray, "c"]
    """Cameras whose intrinsics are exact."""
    photo_of: PhotoByName
    problems: tuple[PhotoProblem, ...]
    seconds: Mapping[str, float]
    sizes: tuple[tuple[int, int], ...]
    """(width, height) of the photo behind each camera."""

    def full_size(self, model: Reconstruction) -> Reconstruction:
        """A reconstruction in working pixels, in the pixels of the photos."""
        cameras = tuple(rescale(c, *size) for c, size in zip(model.cameras, self.sizes, strict=True))
        camera_of_view = np.array([view.camera for view in model.views], dtype=np.int64)
        pixels = model.observations.pixels * self.pixel_factors()[camera_of_view[model.observations.view]]
        return replace(model, cameras=cameras, observations=replace(model.observations, pixels=pixels))

    def pixel_factors(self) -> Float[np.ndarray, "c 2"]:
        """Pixels of the photo per working pixel, for each camera and axis."""
        return np.array([[w / c.width, h / c.height] for c, (w, h) in zip(self.cameras, self.sizes, strict=True)])


def read_course(folder: Path) -> Material:
    """Given matches and calibration, and the photos for colours and figures where they are there."""
    start = time.perf_counter()
    course = read_course_folder(folder)
    camera = course.camera
    return Material(
        graph=course.graph,
        cameras=(camera,),
        camera_of_image=np.zeros(course.graph.num_images, dtype=np.int64),
        known=np.array([True]),
        photo_of=photos_on_disk([path for path in course.photos if path is not None]),
        problems=course.problems,
        seconds={"reading": time.perf_counter() - start},
        sizes=((camera.width, camera.height),),
    )


def match_photos(folder: Path, options: MatchingOptions, seed: int, on_stage: OnStage) -> Material:
    """Features of every photo, matches of every pair, focal lengths where nobody knows them, two-view geometry.

    Raises:
        InputError: Fewer than two photos can be read.
    """
    on_stage("finding features")
    stop, seconds = _stopwatch()
    found, problems = detect(list_photos(folder), options)
    for problem in problems:
        logger.warning("skipped %s: %s", problem.path.name, problem.reason)
    if len(found) < 2:
        reasons = "".join(f"; {problem.path.name}: {problem.reason}" for problem in problems[:3])
        raise InputError(
            f"{folder}: a reconstruction needs at least two readable photos, found {len(found)}{reasons}; add photos"
        )
    infos, features = [info for info, _ in found], [features for _, features in found]
    stop("features")
    on_stage("matching")
    cameras, camera_of_image, source = cameras_of_photos(infos, options)
    sizes = tuple((camera.width, camera.height) for camera in cameras)
    working = tuple(_reduced(camera, options.sift.max_image_size) for camera in cameras)
    keypoints = [
        f.keypoints * (np.array([working[c].width, working[c].height]) / sizes[c])
        for f, c in zip(features, camera_of_image.tolist(), strict=True)
    ]
    pairs = choose_pairs(
        features,
        options.pairs,
        np.random.default_rng([seed, len(features)]),
        positions=gps_positions(infos),
        threads=options.threads,
    )
    graph = match_features([info.path.name for info in infos], features, keypoints, pairs, options)
    stop("matching")
    on_stage("verifying pairs")
    working = vote_on_unknown(graph, working, camera_of_image, source, options, seed)
    graph = verify_pairs(graph, working, camera_of_image, options.two_view, seed, options.threads)
    stop("verification")
    known = np.array([options.fix_intrinsics and s == "given" for s in source])
    photo_of = photos_on_disk([info.path for info in infos])
    return Material(graph, working, camera_of_image, known, photo_of, tuple(problems), seconds, sizes)


def detect(
    paths: Sequence[Path], options: MatchingOptions
) -> tuple[list[tuple[PhotoInfo, Features]], list[PhotoProblem]]:
    """Features of every readable photo, in the order of the paths, and the files that are none.

    Decoding and extraction release the interpreter lock. A photo is let go as soon as its features are known.
    """
    extractor = Sift(options.sift)

    def one(path: Path) -> tuple[PhotoInfo, Features] | PhotoProblem:
        try:
            photo = read_photo(path)
        except InputError as error:
            return PhotoProblem(path, str(error).removeprefix(f"{path}: "))
        return photo.info, extractor(photo.rgb)

    with ThreadPoolExecutor(options.threads) as pool:
        results = list(pool.map(one, paths))
    return (
        [result for result in results if not isinstance(result, PhotoProblem)],
        [result for result in results if isinstance(result, PhotoProblem)],
    )


def photos_on_disk(paths: Sequence[Path]) -> PhotoByName:
    """Photos by name, decoded when they are asked for; the last few are kept."""
    by_name = {path.name: path for path in paths}

    @lru_cache(maxsize=8)
    def photo_of(name: str) -> np.ndarray | None:
        return read_photo(by_name[name]).rgb if name in by_name else None

    return photo_of


def match_features(
    names: list[str],
    features: list[Features],
    keypoints: list[Float[np.ndarray, "_ 2"]],
    pairs: list[ImagePair],
    options: MatchingOptions,
) -> MatchGraph:
    """Putative matches of the pairs, in their order."""
    matcher = MutualRatio(options.max_ratio)
    with ThreadPoolExecutor(options.threads) as pool:
        matches = list(pool.map(lambda pair: matcher(features[pair[0]], features[pair[1]]), pairs))
    return MatchGraph(
        tuple(names),
        tuple(keypoints),
        tuple(f.colors for f in features),
        {pair: rows for pair, rows in zip(pairs, matches, strict=True) if len(rows)},
    )


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


def _reduced(camera: Camera, max_image_size: int) -> Camera:
    """The camera of the photo as reduced for matching."""
    factor = min(1.0, max_image_size / max(camera.width, camera.height))
    return rescale(camera, round(camera.width * factor), round(camera.height * factor))


def _stopwatch() -> tuple[Callable[[str], None], dict[str, float]]:
    """`stop(stage)` notes the wall seconds since the last call; and the notes."""
    seconds: dict[str, float] = {}
    last = [time.perf_counter()]

    def stop(stage: str) -> None:
        now = time.perf_counter()
        seconds[stage] = now - last[0]
        last[0] = now

    return stop, seconds
