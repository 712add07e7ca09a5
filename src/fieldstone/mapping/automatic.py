"""From a verified match graph to finished models, with nothing that has to be set by hand.

Three steps: `place` registers the photos, so that no places that look alike lie upon each other; `finish` calibrates
and adjusts each sub-model; `to_mapping_run` tells of it. `map_automatic` is the three in a row; where photos can be
matched anew, `run.map_photos` recovers unregistered ones between the first and the second.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.disambiguation.disambiguate import Disambiguation, disambiguate
from fieldstone.mapping.disambiguation.options import DisambiguationOptions
from fieldstone.mapping.global_mapper import map_global
from fieldstone.mapping.incremental.checkpoint import CheckpointStore
from fieldstone.mapping.incremental.mapper import collapsed, map_incremental
from fieldstone.mapping.incremental.merging import merge_linked
from fieldstone.mapping.incremental.options import IncrementalOptions
from fieldstone.mapping.incremental.registration import verdict_of_pairs
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.mapping.model.calibration import CalibrationStep, first_step, what_is_wrong_with, with_models
from fieldstone.mapping.model.outliers import drop_outliers
from fieldstone.mapping.model.refinement import (
    RefinementOptions,
    adjust_globally,
    loss_scale,
    refine_until_stable,
)
from fieldstone.mapping.model.uncertainty import camera_certainties, model_uncertainty
from fieldstone.mapping.model.working_model import WorkingModel, record_views, to_reconstruction
from fieldstone.mapping.self_calibration import CalibrationTrial, SelfCalibrationOptions, select_camera_models
from fieldstone.mapping.textbook import four_poses
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.records.mapping import CameraRecord, CameraTrial
from fieldstone.scene.mapping_run import Drop, MappingRun, Uncertainty
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import Observations

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class AutomaticOptions:
    """Disambiguation, registration, self-calibration and the last adjustment."""

    mapper: Literal["incremental", "global"] = "incremental"
    """Photo by photo, or all at once."""
    disambiguation: DisambiguationOptions = field(default_factory=DisambiguationOptions)
    """When pairs are taken for false."""
    incremental: IncrementalOptions = field(default_factory=IncrementalOptions)
    """Registration of photos and bundle adjustment, for both mappers."""
    self_calibration: SelfCalibrationOptions = field(default_factory=SelfCalibrationOptions)
    """Which camera model is believed."""
    min_angle_deg: float = 1.5
    """Points of the result have two rays that meet at this angle at least."""
    covariance: bool = False
    """Whether to compute how well poses and points are determined."""

    def with_threads(self, threads: int) -> AutomaticOptions:
        """The same with so many threads, which changes nothing but the time."""
        return replace(self, incremental=self.incremental.with_threads(threads))


@dataclass(frozen=True, eq=False)
class FinishedModel:
    """One sub-model after its last adjustment."""

    model: WorkingModel
    before: WorkingModel
    drops: tuple[Drop, ...]
    trials: tuple[CalibrationTrial, ...]
    calibration: tuple[CalibrationStep | None, ...]
    refinement: RefinementOptions
    """Of the last adjustments."""


def map_automatic(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    focal_sigma: Float[np.ndarray, "c"],
    options: AutomaticOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> MappingRun:
    """Models of all components; the one with most photos is the reconstruction, the others are kept beside it.

    Args:
        graph: Verified, see `features.verification`.
        focal_sigma: By what share the focal length of each camera may be off: a standard deviation. 0: its intrinsics
            are exact and stay as they are; the others are refined.
        store: Where a registration that was stopped is taken up again.
        on_progress: Told of registered photos and finished models.
    """
    found = place(graph, cameras, camera_of_image, focal_sigma, options, seed, store, on_progress)
    return finish_all(found, cameras, camera_of_image, options, on_progress)


def place(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    focal_sigma: Float[np.ndarray, "c"],
    options: AutomaticOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> Disambiguation:
    """The registered sub-models that the photos speak for; arguments as `map_automatic`."""

    def register_graph(graph: MatchGraph) -> list[SubModel]:
        return register(graph, cameras, camera_of_image, focal_sigma, options, seed, store, on_progress)

    return disambiguate(graph, cameras, camera_of_image, register_graph, options.disambiguation)


def register(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    focal_sigma: Float[np.ndarray, "c"],
    options: AutomaticOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> list[SubModel]:
    """The sub-models of a graph, the one with most photos first; arguments as `map_automatic`."""
    calibration = [
        None if sigma == 0.0 else first_step(camera, sigma)
        for camera, sigma in zip(cameras, focal_sigma.tolist(), strict=True)
    ]
    start_cameras = with_models(cameras, calibration)
    mapper = map_global if options.mapper == "global" else map_incremental
    found = mapper(graph, start_cameras, camera_of_image, calibration, options.incremental, seed, store, on_progress)
    return merge_linked(found, graph, options.incremental, seed)


def finish_all(
    found: Disambiguation,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: AutomaticOptions,
    on_progress: OnProgress = silent,
) -> MappingRun:
    """Every sub-model finished, and the run that tells of them.

    Args:
        cameras: As given, before anything was refined.
    """
    progress = StageProgress(on_progress, "finishing models", len(found.sub_models) + len(found.alternative))
    finished = [finish(each, options) for each in progress.each([*found.sub_models, *found.alternative])]
    count = len(found.sub_models)
    run = to_mapping_run(found.graph, found.sub_models, finished[:count], cameras, camera_of_image, options)
    return with_disambiguation(run, found, [other.model for other in finished[count:]])


def with_disambiguation(run: MappingRun, found: Disambiguation, alternative: Sequence[WorkingModel]) -> MappingRun:
    """The run with what is to be told of places that look alike, and the models of the alternative."""
    verdicts = dict(run.verdicts)
    for name, count in zip(run.graph.names, found.left_out.tolist(), strict=True):
        if count and not verdicts[name].startswith("registered"):
            verdicts[name] += f"; {count} of its pairs were left out, because places look alike (see the notes)"
    notes = [*found.notes]
    if alternative:
        first, last = 1 + len(run.others), len(run.others) + len(alternative)
        places = f"sparse/{first}" if first == last else f"sparse/{first} to sparse/{last}"
        notes.append(f"ambiguous scene: the alternative is in {places}")
    return replace(
        run,
        notes=(*notes, *run.notes),
        verdicts=verdicts,
        alternative=tuple(to_reconstruction(model, run.graph) for model in alternative),
    )


def finish(sub_model: SubModel, options: AutomaticOptions) -> FinishedModel:
    """Self-calibration, then adjustment of everything with everything.

    A camera model that was chosen on a part of the tracks, and that all of them make no lens, is given up.
    """
    refinement = options.incremental.refinement.for_noise(loss_scale(sub_model.model))
    first = tuple(sub_model.calibration)
    calibration, trials = select_camera_models(sub_model.model, first, refinement, options.self_calibration)
    found = _adjusted(sub_model, calibration, trials, refinement, options)
    wrong = next((w for w in map(_wrong_with, found.model.cameras, found.calibration) if w), "")
    if calibration == first or not wrong:
        return found
    logger.warning("the camera model that was chosen is given up: %s", wrong)
    refused = [replace(trial, accepted=False, verdict=wrong) if trial.accepted else trial for trial in trials]
    return _adjusted(sub_model, first, refused, refinement, options)


def _wrong_with(camera: Camera, step: CalibrationStep | None) -> str:
    """Why no lens is like a camera that was refined; "" if there is nothing."""
    return "" if step is None else what_is_wrong_with(camera, step)


def _adjusted(
    sub_model: SubModel,
    calibration: tuple[CalibrationStep | None, ...],
    trials: Sequence[CalibrationTrial],
    refinement: RefinementOptions,
    options: AutomaticOptions,
) -> FinishedModel:
    """Everything adjusted with everything, in the camera models of a calibration."""
    incremental, before = options.incremental, sub_model.model
    limits = incremental.max_error_px, options.min_angle_deg
    model = refine_until_stable(before, refinement, calibration, *limits, bundle=refinement.final, all_points=True)
    model, drops = drop_outliers(model, "end", *limits)
    model = adjust_globally(model, refinement, calibration, bundle=refinement.final, points=model.is_point())
    model, more = drop_outliers(model, "last adjustment", *limits)
    if collapsed(before, model, incremental):
        logger.warning("the last adjustment made the model fall apart: it is left as it was registered")
        return FinishedModel(before, before, (), tuple(trials), sub_model.calibration, incremental.refinement)
    return FinishedModel(model, before, (*drops, *more), tuple(trials), calibration, refinement)


def to_mapping_run(
    graph: MatchGraph,
    sub_models: Sequence[SubModel],
    finished: Sequence[FinishedModel],
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: AutomaticOptions,
) -> MappingRun:
    """The frozen models, and what is to be told of the first and of every photo."""
    verdicts = _verdicts(graph, sub_models, [f.model for f in finished])
    if not finished:
        nothing = WorkingModel.start(tuple(cameras), camera_of_image, Observations.empty())
        return MappingRun(to_reconstruction(nothing, graph), graph, None, (), (), None, verdicts)
    best, first = finished[0], sub_models[0]
    records = record_views(best.before, graph.names, "before BA") + record_views(best.model, graph.names, "after BA")
    start_cameras = with_models(cameras, first.calibration)
    uncertainty, notes = _uncertainty(best) if options.covariance else (None, ())
    trials = tuple(_record(trial) for trial in best.trials)
    certainties = camera_certainties(best.model, best.calibration, best.refinement)
    cameras_found = [CameraRecord.of(*each) for each in zip(best.model.cameras, certainties, strict=True)]
    return MappingRun(
        reconstruction=to_reconstruction(best.model, graph),
        graph=graph,
        initial_pair=four_poses(graph, first.initial_pair, start_cameras, camera_of_image),
        records=tuple(records),
        drops=best.drops,
        before_bundle=to_reconstruction(best.before, graph),
        verdicts=verdicts,
        others=tuple(to_reconstruction(other.model, graph) for other in finished[1:]),
        notes=(*(_describe(trial) for trial in trials), *(_describe_camera(c) for c in cameras_found), *notes),
        uncertainty=uncertainty,
        calibration=trials,
        certainties=certainties,
    )


def _uncertainty(best: FinishedModel) -> tuple[Uncertainty | None, tuple[str, ...]]:
    """How well the model is determined; where that cannot be computed, nothing and a note that says why."""
    try:
        return model_uncertainty(best.model, best.calibration, best.refinement), ()
    except ValueError as error:
        logger.warning("no covariance: %s", error)
        return None, (f"no covariance: {error}",)


def _verdicts(graph: MatchGraph, sub_models: Sequence[SubModel], models: Sequence[WorkingModel]) -> dict[str, str]:
    """For every photo: in which model with how many points, or why in none."""
    out = {}
    for view, name in enumerate(graph.names):
        home = next((k for k, model in enumerate(models) if model.registered[view]), None)
        if home is None:
            tried = [s.failures[view] for s in sub_models if view in s.failures]
            out[name] = f"not registered: {'; '.join([*tried[:1], verdict_of_pairs(graph, view)])}"
        elif home == 0:
            out[name] = f"registered: {len(models[0].observations_of(view))} points; {sub_models[0].reasons[view]}"
        else:
            out[name] = f"in a model of its own ({home + 1} of {len(models)}): {verdict_of_pairs(graph, view)}"
    return out


def _record(trial: CalibrationTrial) -> CameraTrial:
    """What is kept of a camera model that was tried."""
    return CameraTrial(
        model=trial.step.model,
        free=tuple(trial.step.free),
        rms_before_px=float(trial.rms_before_px),
        rms_after_px=float(trial.rms_after_px),
        significance=float(trial.significance),
        accepted=bool(trial.accepted),
        verdict=trial.verdict,
    )


def _describe(trial: CameraTrial) -> str:
    """One line on one camera model that was tried."""
    verdict = "taken" if trial.accepted else "refused"
    return (
        f"calibration {trial.model} with {', '.join(trial.free)} free: held-out observations predicted to "
        f"{trial.rms_after_px:.4f} px, the simplest model to {trial.rms_before_px:.4f} px "
        f"({trial.significance:+.1f} standard errors), {verdict}: {trial.verdict}"
    )


def _describe_camera(camera: CameraRecord) -> str:
    """One line on the intrinsics that a model ended with."""
    certainty = "" if camera.certainty is None else f"; {camera.certainty}: {camera.reason}"
    return f"camera {camera.model}: {camera.params_with_sds()}{certainty}"
