"""Photos without what does not move with the scene."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fieldstone.features.sift import Sift
from fieldstone.features.static_content import StaticContent, find_static_content
from fieldstone.geometry.camera import Camera
from fieldstone.io.files.cache import UnitCache
from fieldstone.run.matching.detection import DetectedPhoto, opencv_threads, searched
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.scene.match_graph import MatchGraph

logger = logging.getLogger(__name__)

MAX_ROUNDS = 3
"""Of looking for what does not move: where photos are searched again without it, they show more of it."""


def leave_out_static_content(
    photos: Sequence[DetectedPhoto],
    match: Callable[[Sequence[DetectedPhoto]], MatchGraph],
    cameras: Sequence[Camera],
    options: MatchingOptions,
    seed: int,
    cache: UnitCache,
) -> tuple[Sequence[DetectedPhoto], MatchGraph, list[str]]:
    """The photos less their features that are fixed to the camera, their putative matches, and a line on it.

    Photos that show too little else are searched again without the regions that stand still.

    Args:
        match: Finds putative matches.
        cameras: Of every photo.
    """
    graph, notes = match(photos), []
    for _ in range(MAX_ROUNDS):
        found = find_static_content(graph, cameras, options.two_view, seed, options.threads)
        if found is not None and not notes:
            notes = [_note(found, len(photos))]
            logger.warning("%s", notes[0])
        if found is None or not found.decided:
            break
        photos = _without(photos, found, Sift(options.sift), options.threads, cache)
        graph = match(photos)
    return photos, graph, notes


def _without(
    photos: Sequence[DetectedPhoto], found: StaticContent, extractor: Sift, threads: int, cache: UnitCache
) -> list[DetectedPhoto]:
    """Photos without what was found, searched again where that makes a difference."""

    def left(k: int) -> DetectedPhoto:
        static, cells = found.features[k], found.regions[k]
        if not static.any():
            return photos[k]
        rest = photos[k].without(static, cells)
        worth = cells is not None and extractor.decides_otherwise(photos[k].features, rest.features)
        return searched(rest, extractor, cache) if worth else rest

    with opencv_threads(1), ThreadPoolExecutor(threads) as pool:
        return list(pool.map(left, range(len(photos))))


def _note(found: StaticContent, num_photos: int) -> str:
    """What a user should know of it."""
    if not found.decided:
        return (
            "most pairs of photos show no motion, and nothing else moves in them: either the camera stood still, or "
            "something is fixed to it; move the camera, or give masks"
        )
    with_any = sum(bool(static.any()) for static in found.features)
    features = float(np.mean(np.concatenate(found.features)))
    return (
        f"something does not move with the scene (an overlay, a watermark, a background that stands still): "
        f"{100 * features:.0f} % of the features, and {100 * found.share:.0f} % of the area, of {with_any} of "
        f"{num_photos} photos are left out; {found.num_pairs} pairs show it"
    )
