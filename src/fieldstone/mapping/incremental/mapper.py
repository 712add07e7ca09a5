"""The incremental mapper: sub-models that begin with a pair of photos and take in one photo after the other.

Initialise with the best pair; then choose the next photo, register it, triangulate, adjust the bundle around it or of
everything, and undo what makes the model collapse. When no photo is left that fits, thresholds are relaxed, stage by
stage; in the last one, photos that see no points are placed by their relative poses.

Source:
    The pipeline of `schonberger2016`.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.incremental.checkpoint import Checkpoint, CheckpointStore
from fieldstone.mapping.incremental.initialization import initialize, rank_initial_pairs
from fieldstone.mapping.incremental.options import RETRY_STAGES, IncrementalOptions, RetryStage
from fieldstone.mapping.incremental.registration import contradicts_pairs, register_view
from fieldstone.mapping.incremental.state import RegistrationState, RegistrationTask, SubModel, largest_first
from fieldstone.mapping.incremental.structureless import pose_from_partners
from fieldstone.mapping.incremental.view_selection import next_view
from fieldstone.mapping.model.calibration import CalibrationStep
from fieldstone.mapping.model.refinement import adjust_globally, adjust_locally, refine_until_stable
from fieldstone.mapping.model.triangulation import retriangulate, tracks_of_view
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.tracks import build_tracks

logger = logging.getLogger(__name__)


def map_incremental(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    calibration: Sequence[CalibrationStep | None],
    options: IncrementalOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> list[SubModel]:
    """Every sub-model of the graph that a pair can start, the one with most photos first.

    Args:
        graph: Verified: `two_views` hold the geometry and inliers of every pair.
        calibration: Per camera, what may be refined from the start; None keeps its intrinsics as they are.
        store: Where a registration that was stopped is taken up again.
        on_progress: Told of registered photos.

    Returns:
        Models that share no photo, before the final refinement; empty if no pair gives a start.
    """
    tracks, _ = build_tracks(graph, split_conflicts=True)
    empty = WorkingModel.start(tuple(cameras), camera_of_image, tracks, graph.pixel_scale)
    progress = StageProgress(on_progress, "registering photos", graph.num_images)
    available = np.ones(graph.num_images, dtype=bool)
    sub_models: list[SubModel] = []
    for stage in RETRY_STAGES:
        while available.sum() >= options.min_model_size:
            held = int(np.sum(~available))
            task = RegistrationTask(
                graph, available, tuple(calibration), options, seed, lambda count, held=held: progress.at(held + count)
            )
            sub_model = _map_one(empty, stage, task, store)
            if sub_model is None:
                break
            sub_models.append(sub_model)
            available = available & ~sub_model.model.registered
            logger.info("sub-model of %d photos", sub_model.num_registered)
        if sub_models:
            break  # what a strict start left over is retried from the model itself, not by a weak start of its own
    return largest_first(sub_models)


def _map_one(
    empty: WorkingModel, stage: RetryStage, task: RegistrationTask, store: CheckpointStore | None
) -> SubModel | None:
    """The first sub-model that takes in more than its initial pair; failing that, that of the best stable pair."""
    fallback = None
    for candidate in rank_initial_pairs(task.graph, empty, task.available, stage, task.options.max_initial_pairs):
        model = initialize(empty, candidate, stage, task.options)
        if model is None:
            continue
        reasons = dict.fromkeys(candidate.pair, f"start of the model: {candidate.num_points} points")
        sub_model = extend(RegistrationState.start(model, reasons), candidate.pair, task, store)
        if sub_model.num_registered > 2 or task.available.sum() == 2:
            return sub_model
        fallback = fallback or sub_model
    return fallback


def extend(
    start: RegistrationState, initial_pair: ImagePair, task: RegistrationTask, store: CheckpointStore | None = None
) -> SubModel:
    """Register photo after photo until no available one fits, with thresholds relaxed stage by stage.

    Args:
        store: Keeps the state after every global adjustment; registration goes on from the one it has.
    """
    checkpoint = Checkpoint.of(store, start, initial_pair, task)
    state = checkpoint.last(start)
    for retry_stage in range(state.retry_stage, len(RETRY_STAGES)):
        state = register_all_that_fit(state.at_stage(retry_stage), task, checkpoint)
        if not state.unregistered(task.available):
            break
        state = refine_before_retry(state, task)
    return SubModel(state.model, initial_pair, state.reasons, state.failures, task.calibration)


def register_all_that_fit(
    state: RegistrationState, task: RegistrationTask, checkpoint: Checkpoint
) -> RegistrationState:
    """One retry stage: photos from the points that they see; in the last stage, others from their relative poses."""
    while True:
        state = register_from_points(state, task, checkpoint)
        if not state.in_last_stage:
            return state
        before = state.model.num_registered
        state = register_one_without_points(state, task, checkpoint)
        if state.model.num_registered == before:
            return state


def register_from_points(state: RegistrationState, task: RegistrationTask, checkpoint: Checkpoint) -> RegistrationState:
    """Register the photo that sees the points best, again and again, until none is left that sees enough of them."""
    excluded = frozenset(np.flatnonzero(~task.available).tolist())
    while (view := next_view(state.model, state.tried | excluded, state.thresholds.min_inliers)) is not None:
        rng = np.random.default_rng([task.seed, view, state.model.num_registered, state.retry_stage])
        attempt = register_view(state.model, view, task.options.pnp, state.thresholds.min_inliers, rng)
        pose, reason = attempt.cam_from_world, attempt.reason()
        if pose is None:
            state = state.with_failure(view, reason)
        elif against := contradicts_pairs(state.model, task.graph, view, pose):
            state = state.with_failure(view, f"{reason}, but {against}")
        else:
            state = take_in(state, view, pose, reason, task, checkpoint)
    return state


def register_one_without_points(
    state: RegistrationState, task: RegistrationTask, checkpoint: Checkpoint
) -> RegistrationState:
    """Register the first photo that relative poses to registered photos place; after it, others may see points."""
    before = state.model.num_registered
    for view in state.unregistered(task.available):
        pose = pose_from_partners(state.model, task.graph, view, state.thresholds.min_inliers)
        if pose is not None:
            state = take_in(state, view, pose, "placed by relative poses, without points", task, checkpoint)
        if state.model.num_registered > before:
            break
    return state


def take_in(
    state: RegistrationState,
    view: int,
    cam_from_world: Rigid3,
    reason: str,
    task: RegistrationTask,
    checkpoint: Checkpoint,
) -> RegistrationState:
    """Triangulate and adjust with one more photo; if the model collapses, the state with its failure."""
    is_global = needs_global_adjustment(state, task.options)
    larger = adjusted_with(state, view, cam_from_world, task, is_global=is_global)
    if larger is None:
        return state.with_failure(view, f"{reason}, but the model falls apart with it")
    logger.info("registered view %d: %s", view, reason)
    task.on_registered(larger.num_registered)
    state = state.with_registered(view, larger, reason)
    return checkpoint.keep(state.after_global_adjustment()) if is_global else state


def needs_global_adjustment(state: RegistrationState, options: IncrementalOptions) -> bool:
    """Whether the model with one more photo is small, or has grown by a factor since its last global adjustment."""
    size = state.model.num_registered + 1
    return (
        size <= options.refinement.always_global or size >= options.refinement.global_growth_ratio * state.num_at_global
    )


def adjusted_with(
    state: RegistrationState, view: int, cam_from_world: Rigid3, task: RegistrationTask, *, is_global: bool
) -> WorkingModel | None:
    """The adjusted model with one more photo; None if that costs it its points, or the photo sees too few of them."""
    options, thresholds = task.options, state.thresholds
    limits = {"max_error_px": options.max_error_px, "min_angle_deg": thresholds.min_angle_deg}
    model = state.model.with_pose(view, cam_from_world)
    model = retriangulate(model, tracks_of_view(model, view), **limits)
    if is_global:
        model, moved = adjust_globally(model, options.refinement, task.calibration), model.all_tracks()
    else:
        model, moved = adjust_locally(model, view, options.refinement)
    model = retriangulate(model, moved, **limits)
    too_few = len(model.observations_of(view)) < thresholds.min_inliers
    return None if too_few or collapsed(state.model, model, options) else model


def refine_before_retry(state: RegistrationState, task: RegistrationTask) -> RegistrationState:
    """Adjust and triangulate everything anew when no photo fits any more; undone if the model collapses."""
    options = task.options
    refined = refine_until_stable(
        state.model, options.refinement, task.calibration, options.max_error_px, state.thresholds.min_angle_deg
    )
    return state if collapsed(state.model, refined, options) else replace(state, model=refined)


def collapsed(before: WorkingModel, after: WorkingModel, options: IncrementalOptions) -> bool:
    """Whether a step has cost the model most of its points: what was finished is not given up for it."""
    return bool(after.is_point().sum() < options.min_kept_points * before.is_point().sum())


def continue_with_graph(
    sub_model: SubModel,
    graph: MatchGraph,
    available: Bool[np.ndarray, "n"],
    options: IncrementalOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> SubModel | None:
    """The poses of a sub-model on the tracks of a graph with more matches, extended by photos that now fit.

    Args:
        available: Photos that no other sub-model holds.

    Returns:
        None if the points do not come back.
    """
    progress = StageProgress(on_progress, "registering photos", graph.num_images)
    task = RegistrationTask(graph, available, sub_model.calibration, options, seed, progress.at)
    tracks, _ = build_tracks(graph, split_conflicts=True)
    model = sub_model.model.on_tracks(tracks)
    model = retriangulate(
        model, model.all_tracks(), max_error_px=options.max_error_px, min_angle_deg=RETRY_STAGES[0].min_angle_deg
    )
    if collapsed(sub_model.model, model, options):
        return None
    return extend(RegistrationState.start(model, sub_model.reasons), sub_model.initial_pair, task, store)
