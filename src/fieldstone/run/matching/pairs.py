"""Pairs of photos to a verified graph; matches and geometry are kept as they are found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Int

from fieldstone.features.matching import match_faint, match_mutual
from fieldstone.features.verification import two_views_of_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.cache import Packing, Unit, UnitCache, code_version, key_of, resumed
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.run.matching.detection import DetectedPhoto
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView


def match_pairs(
    photos: Sequence[DetectedPhoto],
    pairs: Sequence[ImagePair],
    options: MatchingOptions,
    cache: UnitCache,
    on_progress: OnProgress = silent,
) -> MatchGraph:
    """Putative matches of the pairs, in their order; pairs without any are left out."""
    features = [photo.features for photo in photos]
    progress = StageProgress(on_progress, "matching", len(pairs))

    def work(some: Sequence[ImagePair]) -> Iterator[Int[np.ndarray, "_ 2"]]:
        progress.at(len(pairs) - len(some))  # the others are kept from an earlier run
        with ThreadPoolExecutor(options.threads) as pool:
            matches = pool.map(lambda pair: match_pair(photos, features, pair, options.max_ratio), some)
            yield from progress.each(matches)

    keys = [key_of(code_version(), photos[i].key, photos[j].key, options.max_ratio) for i, j in pairs]
    packing = Packing(lambda rows: Unit({"rows": rows}), lambda unit: unit.arrays["rows"])
    matches = resumed(cache, "matches", keys, pairs, work, packing)
    return MatchGraph(
        tuple(photo.name for photo in photos),
        tuple(photo.features.keypoints for photo in photos),
        tuple(photo.features.colors for photo in photos),
        {pair: rows for pair, rows in zip(pairs, matches, strict=True) if len(rows)},
        pixel_scale=np.array([photo.pixel_scale(options.sift.max_image_size) for photo in photos]),
    )


def match_pair(
    photos: Sequence[DetectedPhoto], features: Sequence[Features], pair: ImagePair, max_ratio: float
) -> Int[np.ndarray, "m 2"]:
    """Putative matches of two photos.

    Args:
        features: Of every photo.
        max_ratio: Ratio test of photos without faint features.
    """
    a, b = (features[k] for k in pair)
    return match_faint(a, b) if any(photos[k].faint for k in pair) else match_mutual(a, b, max_ratio)


def verify(
    graph: MatchGraph,
    photos: Sequence[DetectedPhoto],
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: MatchingOptions,
    seed: int,
    cache: UnitCache,
    on_progress: OnProgress = silent,
) -> MatchGraph:
    """The graph with the geometry of every pair, see `features.verification.verify_pairs`."""
    pairs = sorted(graph.matches)
    progress = StageProgress(on_progress, "verifying pairs", len(pairs))

    def work(some: Sequence[ImagePair]) -> Iterator[TwoView]:
        progress.at(len(pairs) - len(some))
        found = two_views_of_pairs(graph, some, cameras, camera_of_image, options.two_view, seed, options.threads)
        return progress.each(found)

    def key(pair: ImagePair) -> str:
        used = [cameras[camera_of_image[k]] for k in pair]
        return key_of(
            code_version(), [photos[k].key for k in pair], options.max_ratio, used, options.two_view, [seed, *pair]
        )

    packing = Packing(_pack, _unpack)
    found = resumed(cache, "two_views", [key(pair) for pair in pairs], pairs, work, packing)
    return graph.with_two_views(dict(zip(pairs, found, strict=True)))


def _pack(two_view: TwoView) -> Unit:
    arrays = {"matrix": two_view.matrix, "inliers": two_view.inliers}
    if two_view.cam2_from_cam1 is not None:
        arrays |= {"R": two_view.cam2_from_cam1.R, "t": two_view.cam2_from_cam1.t}
    return Unit(arrays, {"kind": two_view.kind})


def _unpack(unit: Unit) -> TwoView:
    arrays = unit.arrays
    pose = Rigid3(arrays["R"], arrays["t"]) if "R" in arrays else None
    return TwoView(unit.facts["kind"], arrays["matrix"], pose, arrays["inliers"])
