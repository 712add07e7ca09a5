"""A second look at photos that no model took in: more matches, then the growth goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.incremental.checkpoint import GrowthMemory
from fieldstone.mapping.incremental.mapper import LADDER, GrownModel, IncrementalOptions, collapsed, grow
from fieldstone.mapping.model.triangulation import retriangulate
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import build_tracks

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Wanted:
    """Photos that need matches, those that a model holds, and the cameras as the model knows them."""

    lost: tuple[int, ...]
    registered: Bool[np.ndarray, "n"]
    cameras: tuple[Camera, ...]


MoreMatches = Callable[[MatchGraph, Wanted], MatchGraph | None]
"""A verified graph with more matches of the lost photos; None if there are none. Other photos keep their keypoints."""


def rescue(
    grown: list[GrownModel],
    graph: MatchGraph,
    attempts: Sequence[MoreMatches],
    options: IncrementalOptions,
    seed: int,
    memory: GrowthMemory | None = None,
) -> tuple[list[GrownModel], MatchGraph]:
    """The models with the largest one grown further where more matches allow it, and the graph that it took.

    Attempts are made in turn while photos are left that no model holds; one that gains no photo changes nothing.
    """
    for attempt in attempts:
        held = np.any([g.model.registered_mask() for g in grown], axis=0)
        lost = tuple(np.flatnonzero(~held).tolist())
        if not lost:
            break
        largest = grown[0]
        registered = largest.model.registered_mask()
        larger_graph = attempt(graph, Wanted(lost, registered, largest.model.cameras))
        if larger_graph is None:
            continue
        larger = _go_on(largest, larger_graph, ~held | registered, options, seed, memory)
        gained = 0 if larger is None else int(larger.model.registered_mask().sum() - registered.sum())
        logger.info("a second look at %d photos places %d of them", len(lost), gained)
        if larger is not None and gained > 0:
            grown, graph = [larger, *grown[1:]], larger_graph
    return grown, graph


def _go_on(
    grown: GrownModel,
    graph: MatchGraph,
    free: Bool[np.ndarray, "n"],
    options: IncrementalOptions,
    seed: int,
    memory: GrowthMemory | None,
) -> GrownModel | None:
    """The same poses on the tracks of another graph, grown further; None if the points do not come back."""
    tracks, _ = build_tracks(graph, split_conflicts=True)
    start = WorkingModel.start(grown.model.cameras, grown.model.camera_of_view, tracks)
    model = replace(start, poses=grown.model.poses)
    model = retriangulate(
        model,
        np.ones(len(model.xyz), dtype=bool),
        max_error_px=options.max_error_px,
        min_angle_deg=LADDER[0].min_angle_deg,
    )
    if collapsed(grown.model, model):
        return None
    return grow(model, graph, grown.initial_pair, grown.reasons, free, grown.calibration, options, seed, memory)
