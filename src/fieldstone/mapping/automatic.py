"""From a verified match graph to finished models, with nothing that has to be set by hand."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.disambiguation.ambiguity import resolve_ambiguity, with_ambiguity
from fieldstone.mapping.global_mapper import map_global
from fieldstone.mapping.incremental.checkpoint import GrowthMemory
from fieldstone.mapping.incremental.mapper import GrownModel, IncrementalOptions, collapsed, map_incremental
from fieldstone.mapping.incremental.recovery import MoreMatches, rescue
from fieldstone.mapping.incremental.registration import verdict_of_pairs
from fieldstone.mapping.model.calibration import CalibrationStep, growing_step, with_models
from fieldstone.mapping.model.outliers import drop_outliers
from fieldstone.mapping.model.refinement import RefinementOptions, adjust, loss_scale, refine_until_stable
from fieldstone.mapping.model.uncertainty import model_uncertainty
from fieldstone.mapping.model.working_model import WorkingModel, record_views, to_reconstruction
from fieldstone.mapping.self_calibration import CalibrationTrial, SelfCalibrationOptions, climb
from fieldstone.mapping.textbook import four_poses
from fieldstone.scene.mapping_run import Drop, MappingRun, StageRecord
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import Observations

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class AutomaticOptions:
    """Growing, self-calibration and the last adjustment."""

    mapper: Literal["incremental", "global"] = "incremental"
    """Photo by photo, or all at once."""

    incremental: IncrementalOptions = field(default_factory=IncrementalOptions)
    self_calibration: SelfCalibrationOptions = field(default_factory=SelfCalibrationOptions)
    min_angle_deg: float = 1.5
    """Points of the result have two rays that meet at this angle at least."""
    covariance: bool = False
    """Whether to compute how well poses and points are determined."""

    def with_threads(self, threads: int) -> AutomaticOptions:
        """The same with so many threads, which changes nothing but the time."""
        return replace(self, incremental=self.incremental.with_threads(threads))


@dataclass(frozen=True, eq=False)
class Finished:
    """One component after its last adjustment."""

    model: WorkingModel
    before: WorkingModel
    drops: list[Drop]
    trials: list[CalibrationTrial]
    calibration: tuple[CalibrationStep | None, ...]
    refinement: RefinementOptions
    """Of the last adjustments."""


def map_automatic(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    known: Bool[np.ndarray, "c"],
    options: AutomaticOptions,
    seed: int,
    second_look: Sequence[MoreMatches] = (),
    memory: GrowthMemory | None = None,
) -> MappingRun:
    """Models of all components; the one with most photos is the reconstruction, the others are kept beside it.

    Args:
        graph: Verified, see `features.verification`.
        known: Cameras whose intrinsics are exact and stay as they are; the others are refined.
        second_look: Ways to find more matches for photos that no model takes in, tried in turn.
        memory: Where growth that was stopped is taken up again.
    """
    resolution = resolve_ambiguity(graph, cameras, camera_of_image)
    if resolution.left_out.any():
        second_look = ()  # it would find again what was left out
    run = _map_components(resolution.graph, cameras, camera_of_image, known, options, seed, second_look, memory)
    return with_ambiguity(run, resolution)


def _map_components(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    known: Bool[np.ndarray, "c"],
    options: AutomaticOptions,
    seed: int,
    second_look: Sequence[MoreMatches],
    memory: GrowthMemory | None,
) -> MappingRun:
    """`map_automatic` for a graph whose pairs do not contradict each other."""
    calibration = [None if known[c] else growing_step(camera) for c, camera in enumerate(cameras)]
    start_cameras = with_models(cameras, calibration)
    mapper = map_global if options.mapper == "global" else map_incremental
    grown = mapper(graph, start_cameras, camera_of_image, calibration, options.incremental, seed, memory)
    if not grown:
        verdicts = {name: f"not registered: {verdict_of_pairs(graph, v)}" for v, name in enumerate(graph.names)}
        nothing = WorkingModel.start(tuple(cameras), camera_of_image, Observations.empty())
        return MappingRun(to_reconstruction(nothing, graph), graph, None, (), (), None, verdicts)
    grown, graph = rescue(grown, graph, second_look, options.incremental, seed, memory)
    finished = [finish(component, options, np.random.default_rng([seed, k])) for k, component in enumerate(grown)]
    best = finished[0]
    records: list[StageRecord] = record_views(best.before, graph.names, "before BA")
    records += record_views(best.model, graph.names, "after BA")
    start = grown[0].initial_pair
    uncertainty = model_uncertainty(best.model, best.calibration, best.refinement) if options.covariance else None
    initial = four_poses(graph, start, start_cameras, camera_of_image)
    return MappingRun(
        to_reconstruction(best.model, graph),
        graph,
        initial,
        tuple(records),
        tuple(best.drops),
        to_reconstruction(best.before, graph),
        _verdicts(graph, grown, [f.model for f in finished]),
        tuple(to_reconstruction(other.model, graph) for other in finished[1:]),
        tuple(_describe(trial) for trial in best.trials) + tuple(_describe_camera(c) for c in best.model.cameras),
        uncertainty,
    )


def finish(grown: GrownModel, options: AutomaticOptions, rng: np.random.Generator) -> Finished:
    """Self-calibration, then adjustment of everything with everything."""
    incremental = options.incremental
    refinement = incremental.refinement.for_noise(loss_scale(grown.model))
    before = grown.model
    calibration, trials = climb(grown.model, grown.calibration, refinement, options.self_calibration, rng)
    model = refine_until_stable(
        grown.model,
        refinement,
        calibration,
        incremental.max_error_px,
        options.min_angle_deg,
        bundle=refinement.final,
        all_points=True,
    )
    model, drops = drop_outliers(model, "end", incremental.max_error_px, options.min_angle_deg)
    model = adjust(model, refinement, calibration, bundle=refinement.final, points=model.is_point())
    model, more = drop_outliers(model, "last adjustment", incremental.max_error_px, options.min_angle_deg)
    if collapsed(before, model):
        logger.warning("the last adjustment made the model fall apart: it is left as it had grown")
        return Finished(before, before, [], trials, grown.calibration, incremental.refinement)
    return Finished(model, before, drops + more, trials, calibration, refinement)


def _verdicts(graph: MatchGraph, grown: list[GrownModel], models: list[WorkingModel]) -> dict[str, str]:
    """For every photo: in which model with how many points, or why in none."""
    out = {}
    for view, name in enumerate(graph.names):
        home = next((k for k, model in enumerate(models) if model.poses[view] is not None), None)
        if home is None:
            tried = [g.failures[view] for g in grown if view in g.failures]
            out[name] = f"not registered: {'; '.join([*tried[:1], verdict_of_pairs(graph, view)])}"
        elif home == 0:
            out[name] = f"registered: {len(models[0].observations_of(view))} points; {grown[0].reasons[view]}"
        else:
            out[name] = f"in a model of its own ({home + 1} of {len(models)}): {verdict_of_pairs(graph, view)}"
    return out


def _describe(trial: CalibrationTrial) -> str:
    """One line on one step of the ladder."""
    verdict = "accepted" if trial.accepted else "refused"
    return (
        f"calibration {trial.step.model} with {', '.join(trial.step.free)} free: held-out observations predicted to "
        f"{trial.rms_after_px:.4f} px instead of {trial.rms_before_px:.4f} px "
        f"({trial.significance:+.1f} standard errors), {verdict}"
    )


def _describe_camera(camera: Camera) -> str:
    """One line on the intrinsics that a model ended with."""
    values = ", ".join(f"{n} {v:.6g}" for n, v in zip(camera.spec.param_names, camera.params, strict=True))
    return f"camera {camera.model}: {values}"
