"""The incremental mapper: from the best pair, photo by photo, to every component that the matches hold together."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.incremental.checkpoint import GrowthMemory, GrowthState, Kept, as_found_again, name_of_growth
from fieldstone.mapping.incremental.registration import Start, contradicts_pairs, rank_starts, register_view
from fieldstone.mapping.incremental.structureless import pose_from_partners
from fieldstone.mapping.incremental.view_selection import next_views
from fieldstone.mapping.model.calibration import CalibrationStep
from fieldstone.mapping.model.refinement import RefinementOptions, adjust, adjust_around, refine_until_stable
from fieldstone.mapping.model.triangulation import retriangulate, tracks_of_view
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.tracks import build_tracks
from fieldstone.solve.robust.ransac import RansacOptions

logger = logging.getLogger(__name__)

KEPT_SHARE = 0.5
"""A step after which fewer of the points are left is undone."""


@dataclass(frozen=True)
class Stage:
    """Thresholds of one rung of the retry ladder; the first is strict, the later ones relax."""

    min_start_angle_deg: float
    min_start_points: int
    min_inliers: int
    min_angle_deg: float
    """Points whose rays meet at a smaller angle are no points."""


LADDER = (
    Stage(min_start_angle_deg=8.0, min_start_points=100, min_inliers=30, min_angle_deg=1.5),
    Stage(min_start_angle_deg=4.0, min_start_points=50, min_inliers=20, min_angle_deg=1.0),
    Stage(min_start_angle_deg=1.5, min_start_points=25, min_inliers=12, min_angle_deg=0.5),
)


@dataclass(frozen=True)
class IncrementalOptions:
    """How a model grows."""

    max_error_px: float = 4.0
    """Observations with a larger reprojection error are no inliers of their point; pixels of the matched photos."""
    pnp: RansacOptions = field(default_factory=lambda: RansacOptions(max_error_px=8.0))
    """Registration of a photo."""
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    """Bundle adjustment while growing and at the end."""
    min_model_size: int = 2
    """Smallest component that is kept."""
    max_starts: int = 8
    """Pairs tried as the start of one component, at each rung of the ladder."""

    def with_threads(self, threads: int) -> IncrementalOptions:
        """The same with so many threads, which changes nothing but the time."""
        return replace(self, refinement=replace(self.refinement, threads=threads))


@dataclass(frozen=True, eq=False)
class GrownModel:
    """One component, the rung of the ladder that each photo needed, and the calibration it ended with."""

    model: WorkingModel
    initial_pair: ImagePair
    """The pair that it started from."""
    reasons: dict[int, str]
    """Per registered photo, the numbers of its registration."""
    failures: dict[int, str]
    """Per photo that was tried and not registered, the numbers of its last attempt."""
    calibration: tuple[CalibrationStep | None, ...]


def map_incremental(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    calibration: Sequence[CalibrationStep | None],
    options: IncrementalOptions,
    seed: int,
    memory: GrowthMemory | None = None,
) -> list[GrownModel]:
    """Every component of the graph that grows from a pair, the one with most photos first.

    Args:
        graph: Verified: `two_views` hold the geometry and inliers of every pair.
        calibration: Per camera, what may be refined from the start; None keeps its intrinsics as they are.
        memory: Where growth that was stopped is taken up again.

    Returns:
        Models that share no photo, before the final refinement; empty if no pair gives a start.
    """
    tracks, _ = build_tracks(graph, split_conflicts=True)
    empty = WorkingModel.start(tuple(cameras), camera_of_image, tracks)
    free = np.ones(graph.num_images, dtype=bool)
    grown: list[GrownModel] = []
    for stage in LADDER:
        while free.sum() >= options.min_model_size:
            model = _grow_one(graph, empty, free, tuple(calibration), stage, options, seed, memory)
            if model is None:
                break
            grown.append(model)
            free = free & ~model.model.registered_mask()
            logger.info("component of %d photos", model.model.registered_mask().sum())
        if grown:
            break  # what a strict start left over is retried from the model itself, not by a weak start of its own
    return sorted(grown, key=lambda g: -int(g.model.registered_mask().sum()))


def _grow_one(
    graph: MatchGraph,
    empty: WorkingModel,
    free: Bool[np.ndarray, "n"],
    calibration: tuple[CalibrationStep | None, ...],
    stage: Stage,
    options: IncrementalOptions,
    seed: int,
    memory: GrowthMemory | None,
) -> GrownModel | None:
    """The model of the first start that grows beyond its pair; failing that, the best pair that is stable."""
    fallback = None
    angle, points = stage.min_start_angle_deg, stage.min_start_points
    for start in rank_starts(graph, empty, free, angle, points, options.max_starts):
        model = start_model(empty, start, stage, options)
        if model is None:
            continue
        reasons = dict.fromkeys(start.pair, f"start of the model: {start.num_points} points")
        grown = grow(model, graph, start.pair, reasons, free, calibration, options, seed, memory)
        if grown.model.registered_mask().sum() > 2 or free.sum() == 2:
            return grown
        fallback = fallback or grown
    return fallback


def start_model(empty: WorkingModel, start: Start, stage: Stage, options: IncrementalOptions) -> WorkingModel | None:
    """Two posed views and their points after bundle adjustment; None if too few points remain."""
    i, j = start.pair
    model = empty.with_pose(i, Rigid3.identity()).with_pose(j, start.cam2_from_cam1)
    everything = np.ones(len(model.xyz), dtype=bool)
    for _ in range(2):
        model = retriangulate(model, everything, max_error_px=options.max_error_px, min_angle_deg=stage.min_angle_deg)
        if model.is_point().sum() < stage.min_start_points // 2:
            return None
        model = adjust(model, options.refinement, (None,) * len(model.cameras))
    return retriangulate(model, everything, max_error_px=options.max_error_px, min_angle_deg=stage.min_angle_deg)


def grow(
    model: WorkingModel,
    graph: MatchGraph,
    initial_pair: ImagePair,
    reasons: dict[int, str],
    free: Bool[np.ndarray, "n"],
    calibration: tuple[CalibrationStep | None, ...],
    options: IncrementalOptions,
    seed: int,
    memory: GrowthMemory | None = None,
) -> GrownModel:
    """Register photo after photo until none of the free ones fits, relaxing the thresholds step by step.

    Every registration is followed by a bundle adjustment: of everything while the model is small or has grown by a
    share, of the photo and its neighbours otherwise. What no points place is tried from relative poses in the end.

    Args:
        reasons: For the photos that are registered already.
        memory: Keeps the state after every adjustment of everything; the growth goes on from the one it has.
    """
    state = GrowthState(model, 0, dict(reasons), {})
    parts = [list(initial_pair), list(calibration), options.with_threads(1), seed]
    kept = None if memory is None else Kept(memory, name_of_growth(memory, model, graph, free, parts))
    state = state if kept is None else kept.last(state)
    model, reasons, failures = state.model, state.reasons, state.failures
    blocked = frozenset(np.flatnonzero(~free).tolist())
    last_global = int(model.registered_mask().sum())
    for rung, stage in list(enumerate(LADDER))[state.rung :]:
        tried: frozenset[int] = frozenset()
        without_points: list[int] | None = None
        while True:
            candidates = next_views(model, tried | blocked, stage.min_inliers)
            if candidates:
                view = candidates[0]
                rng = np.random.default_rng([seed, view, int(model.registered_mask().sum()), rung])
                result = register_view(model, view, options.pnp, stage.min_inliers, rng)
                pose, reason = result.cam_from_world, result.reason()
                if pose is not None and (against := contradicts_pairs(model, graph, view, pose)):
                    pose, reason = None, f"{reason}, but {against}"
            elif stage is LADDER[-1]:
                if without_points is None:
                    without_points = np.flatnonzero(free & ~model.registered_mask()).tolist()
                if not without_points:
                    break
                view = without_points.pop(0)
                pose = pose_from_partners(model, graph, view, stage.min_inliers)
                reason = "placed by relative poses, without points"
                if pose is None:
                    continue
            else:
                break
            if pose is None:
                tried |= {view}
                failures[view] = reason
                continue
            size = int(model.registered_mask().sum()) + 1
            everything = size <= options.refinement.always_global or size >= options.refinement.growth * last_global
            larger = _with_view(model, view, pose, stage, everything, calibration, options)
            if larger is None:
                tried |= {view}
                failures[view] = f"{reason}, but the model falls apart with it"
                continue
            model = larger
            logger.info("registered view %d: %s", view, reason)
            reasons[view] = reason
            failures.pop(view, None)
            without_points = None
            if everything:
                last_global, tried = size, frozenset()  # a better model may take what a worse one could not
                model = as_found_again(GrowthState(model, rung, reasons, failures), kept)
        everyone = model.registered_mask() | ~free
        if everyone.all():
            break
        refined = refine_until_stable(model, options.refinement, calibration, options.max_error_px, stage.min_angle_deg)
        model = model if collapsed(model, refined) else refined
    return GrownModel(model, initial_pair, reasons, failures, calibration)


def _with_view(
    model: WorkingModel,
    view: int,
    pose: Rigid3,
    stage: Stage,
    everything: bool,
    calibration: tuple[CalibrationStep | None, ...],
    options: IncrementalOptions,
) -> WorkingModel | None:
    """The adjusted model with one more photo; None if that costs it its points, or the photo sees too few of them."""
    limits = {"max_error_px": options.max_error_px, "min_angle_deg": stage.min_angle_deg}
    larger = model.with_pose(view, pose)
    larger = retriangulate(larger, tracks_of_view(larger, view), **limits)
    if everything:
        larger, touched = adjust(larger, options.refinement, calibration), np.ones(len(larger.xyz), dtype=bool)
    else:
        larger, touched = adjust_around(larger, view, options.refinement)
    larger = retriangulate(larger, touched, **limits)
    too_few = len(larger.observations_of(view)) < stage.min_inliers
    return None if too_few or collapsed(model, larger) else larger


def collapsed(before: WorkingModel, after: WorkingModel) -> bool:
    """Whether a step has cost the model most of its points: what was finished is not given up for it."""
    return bool(after.is_point().sum() < KEPT_SHARE * before.is_point().sum())
