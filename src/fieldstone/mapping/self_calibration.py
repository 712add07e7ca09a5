"""How rich a camera model the photos support: a richer one must predict observations that it never saw."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import image_from_cam
from fieldstone.mapping.model.calibration import CANDIDATE_STEPS, CalibrationStep, richer_steps
from fieldstone.mapping.model.refinement import Calibration, RefinementOptions, adjust_globally
from fieldstone.mapping.model.triangulation import covering_tracks, plane_coordinates
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.solve.robust.loss import cauchy
from fieldstone.solve.robust.triangulation import triangulate_robust

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SelfCalibrationOptions:
    """When a richer model is believed."""

    held_out: float = 0.25
    """Share of the tracks that judge and take no part in the adjustment."""
    min_gain: float = 0.005
    """A step must lower the mean squared error of prediction by this share at least; one with fewer parameters need
    only lower it."""
    min_significance: float = 3.0
    """And by so many standard errors of the mean difference."""
    max_error_px: float = 4.0
    """Predictions that are further off count as just this bad."""
    min_judges: int = 100
    """With fewer predictions nothing is decided, and the calibration stays as it is."""
    principal_point: bool = True
    """Whether steps that move the principal point are among the candidates."""


@dataclass(frozen=True)
class CalibrationTrial:
    """One candidate against the best before it: robust root mean squares of prediction, and the verdict."""

    step: CalibrationStep
    rms_before_px: float
    rms_after_px: float
    significance: float
    accepted: bool


def select_camera_models(
    model: WorkingModel,
    calibration: Calibration,
    refinement: RefinementOptions,
    options: SelfCalibrationOptions,
    rng: np.random.Generator,
) -> tuple[tuple[CalibrationStep | None, ...], list[CalibrationTrial]]:
    """The richest candidate that held-out tracks agree to, for all cameras that may be refined.

    Every step is fitted on the other tracks from the best model so far and judged on the same predictions: each
    observation of a held-out track from the point that its other observations give. The selection ends after two steps
    in a row that are not believed; where one radial term did not do, a fisheye lens is tried all the same.

    Returns:
        The calibration of each camera (None stays None), and every trial.
    """
    judges = _held_out(model, options.held_out, rng)
    rows = model.used_observations()
    rows = rows[judges[model.tracks.point[rows]]]
    predictions = _leave_one_out(model.tracks.point[rows])
    if len(predictions.target) < options.min_judges or all(step is None for step in calibration):
        return tuple(calibration), []
    learners = covering_tracks(model, refinement.tracks_per_view) & ~judges
    best = tuple(calibration)
    above = [
        () if step is None else richer_steps(step, principal_point=options.principal_point) for step in calibration
    ]
    fitted = adjust_globally(model, refinement, best, bundle=refinement.final, points=learners)
    loss, unit = cauchy(refinement.final.loss_scale_px), model.typical_pixel_scale()

    def badness(model: WorkingModel) -> Float[np.ndarray, "k"]:
        return loss(np.minimum(prediction_errors(model, rows, predictions), options.max_error_px) ** 2)[0]

    errors = badness(fitted)
    trials: list[CalibrationTrial] = []
    refused = 0
    for step in CANDIDATE_STEPS:
        candidate = tuple(step if old is not None and step in above[c] else old for c, old in enumerate(best))
        of_another_kind = step.model == "OPENCV_FISHEYE" and any(old is not None and "k2" in old.free for old in best)
        if candidate == best or (refused == 2 and not of_another_kind):
            continue
        richer = adjust_globally(fitted, refinement, candidate, bundle=refinement.final, points=learners)
        new_errors = badness(richer)
        simpler = _num_free(candidate) < _num_free(best)
        trials.append(_judged(step, errors, new_errors, options, unit, simpler=simpler))
        if trials[-1].accepted:
            best, fitted, errors, refused = candidate, richer, new_errors, 0
        else:
            refused += 1
    return best, trials


def _judged(
    step: CalibrationStep,
    before: Float[np.ndarray, "k"],
    after: Float[np.ndarray, "k"],
    options: SelfCalibrationOptions,
    unit: float,
    *,
    simpler: bool,
) -> CalibrationTrial:
    """Whether a step is believed, by the robust squared errors of the same predictions before and after it.

    Args:
        unit: Pixels of the photos per unit of the errors' roots.
        simpler: It has fewer parameters, and need only predict as well.
    """
    gain = before - after
    significance = float(gain.mean() / max(gain.std() / np.sqrt(len(gain)), 1e-300))
    clear = gain.mean() > options.min_gain * before.mean() and significance > options.min_significance
    accepted = bool(clear or (simpler and gain.mean() > 0.0))
    rms_before_px, rms_after_px = (unit * float(np.sqrt(errors.mean())) for errors in (before, after))
    logger.info(
        "calibration %s %s: predicts to %.4f px instead of %.4f px, %.1f standard errors, %s",
        step.model, "/".join(step.free), rms_after_px, rms_before_px, significance,
        "accepted" if accepted else "refused",
    )  # fmt: skip
    return CalibrationTrial(step, rms_before_px, rms_after_px, significance, accepted)


def _num_free(calibration: Sequence[CalibrationStep | None]) -> int:
    return sum(len(step.free) for step in calibration if step is not None)


@dataclass(frozen=True, eq=False)
class _Predictions:
    """Prediction k: observation `target[k]` from the observations members[starts[k]:starts[k + 1]] of its track."""

    target: Int[np.ndarray, "k"]
    members: Int[np.ndarray, "m"]
    starts: Int[np.ndarray, "k_and_one"]


def prediction_errors(
    model: WorkingModel, rows: Int[np.ndarray, "u"], predictions: _Predictions
) -> Float[np.ndarray, "k"]:
    """Distance of each target to the reprojection of the point that the others of its track give, over the pixel scale.

    inf where they give none.
    """
    uv = plane_coordinates(model, rows)[predictions.members]
    points, _ = triangulate_robust(
        model.cam_from_world,
        model.scaled_focals(),
        model.tracks.view[rows[predictions.members]],
        uv,
        predictions.starts,
        max_error_px=1e6,
        min_angle=1e-4,
    )
    target_rows = rows[predictions.target]
    view = model.tracks.view[target_rows]
    in_cam = model.cam_from_world[view].apply(points)
    out = np.empty(len(view))
    for c, camera in enumerate(model.cameras):
        mine = model.camera_of_view[view] == c
        predicted = image_from_cam(camera, in_cam[mine])
        out[mine] = np.linalg.norm(predicted - model.tracks.pixels[target_rows[mine]], axis=1)
    return np.nan_to_num(out, nan=np.inf) / model.pixel_scale[view]


def _held_out(model: WorkingModel, ratio: float, rng: np.random.Generator) -> Bool[np.ndarray, "t"]:
    """Tracks of at least three used observations, drawn at random."""
    lengths = np.bincount(model.tracks.point[model.used_observations()], minlength=len(model.xyz))
    return (rng.random(len(model.xyz)) < ratio) & (lengths >= 3)


def _leave_one_out(point: Int[np.ndarray, "u"]) -> _Predictions:
    """One prediction for each observation; `point` is sorted."""
    length = np.bincount(point)[point]
    first = np.searchsorted(point, point)
    target = np.repeat(np.arange(len(point)), length)
    offset = np.arange(len(target)) - np.repeat(np.concatenate([[0], np.cumsum(length)])[:-1], length)
    members = first[target] + offset
    others = members != target
    return _Predictions(
        np.arange(len(point)), members[others], np.concatenate([[0], np.cumsum(length - 1)]).astype(np.int64)
    )
