"""Matched photos to models: place the photos, recover those that no model holds, finish."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from fieldstone.features.verification import verify_pairs
from fieldstone.mapping.automatic import AutomaticOptions, finish_all, place
from fieldstone.mapping.disambiguation.disambiguate import Disambiguation
from fieldstone.mapping.incremental.checkpoint import CheckpointStore
from fieldstone.mapping.incremental.mapper import continue_with_graph
from fieldstone.mapping.incremental.options import IncrementalOptions
from fieldstone.mapping.textbook import TextbookOptions, for_pixel_scale, map_textbook
from fieldstone.progress import OnProgress, silent
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photos_to_graph import MatchedPhotos
from fieldstone.run.matching.recovery import RecoveryStage, Rematcher, Unregistered
from fieldstone.run.matching.reverification import with_cameras_of_models
from fieldstone.run.reconstruct_options import Mapper
from fieldstone.scene.mapping_run import MappingRun

logger = logging.getLogger(__name__)

ChosenMapper = Literal["textbook", "incremental", "global"]


def map_photos(
    matched: MatchedPhotos,
    matching: MatchingOptions,
    options: AutomaticOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> MappingRun:
    """Models of verified matches; photos that none of them takes in are matched once more, where they can be.

    Args:
        matching: How the photos were matched, and are matched again.
        store: Where a registration that was stopped is taken up again.
    """
    cameras, camera_of_image = matched.cameras, matched.camera_of_image
    found = place(matched.graph, cameras, camera_of_image, matched.focal_sigma, options, seed, store, on_progress)
    again = with_cameras_of_models(matched, found.sub_models, matching, seed)
    if again is not None:
        matched, cameras = again, again.cameras
        found = place(matched.graph, cameras, camera_of_image, matched.focal_sigma, options, seed, store, on_progress)
    if matched.photos and not found.left_out.any():  # matching anew would find again what was left out
        stages = Rematcher(matched.photos, camera_of_image, matching, seed).stages()
        found = recover(found, stages, options.incremental, seed, store, on_progress)
    return finish_all(found, cameras, camera_of_image, options, on_progress)


def map_given_matches(
    matched: MatchedPhotos,
    mapper: Mapper,
    matching: MatchingOptions,
    options: AutomaticOptions,
    textbook: TextbookOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> tuple[ChosenMapper, MappingRun]:
    """Models of matches that were given without the geometry of pairs, and the mapper that made them.

    Left to `auto`, the textbook mapper takes the matches as they are, unless pairs of different places match falsely:
    it knows of one place only.
    """
    if mapper == "textbook":
        return mapper, map_with_textbook(matched, textbook, seed, on_progress)
    graph, cameras, camera_of_image = matched.graph, matched.cameras, matched.camera_of_image
    graph = verify_pairs(graph, cameras, camera_of_image, matching.two_view, seed, matching.threads, on_progress)
    found = place(graph, cameras, camera_of_image, matched.focal_sigma, options, seed, store, on_progress)
    if mapper == "auto" and not found.notes:
        return "textbook", map_with_textbook(matched, textbook, seed, on_progress)
    return options.mapper, finish_all(found, cameras, camera_of_image, options, on_progress)


def map_with_textbook(
    matched: MatchedPhotos, options: TextbookOptions, seed: int, on_progress: OnProgress = silent
) -> MappingRun:
    """The textbook mapper on the same matches; focal lengths are refined where they are not exact.

    It has one threshold for all photos: that of the largest.
    """
    scale = float(matched.graph.scale_of_image.max(initial=1.0))
    textbook = for_pixel_scale(replace(options, refine_focal=not matched.known.all()), scale)
    return map_textbook(matched.graph, matched.cameras, matched.camera_of_image, textbook, seed, on_progress)


def recover(
    found: Disambiguation,
    stages: Sequence[RecoveryStage],
    options: IncrementalOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> Disambiguation:
    """The same with the largest sub-model extended where more matches allow it.

    Stages of matching follow each other while photos are left that no sub-model holds; one that gains no photo changes
    nothing.
    """
    sub_models, graph = list(found.sub_models), found.graph
    for rematch in stages if sub_models else ():
        largest = sub_models[0]
        registered, held = largest.model.registered, np.any([s.model.registered for s in sub_models], axis=0)
        unregistered = tuple(np.flatnonzero(~held).tolist())
        if not unregistered:
            break
        larger_graph = rematch(graph, Unregistered(unregistered, registered, largest.model.cameras))
        if larger_graph is None:
            continue
        larger = continue_with_graph(largest, larger_graph, ~held | registered, options, seed, store, on_progress)
        gained = 0 if larger is None else larger.num_registered - largest.num_registered
        logger.info("recovery registers %d of %d photos", gained, len(unregistered))
        if larger is not None and gained > 0:
            sub_models, graph = [larger, *sub_models[1:]], larger_graph
    return replace(found, sub_models=tuple(sub_models), graph=graph)
