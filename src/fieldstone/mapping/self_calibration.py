"""How rich a camera model the photos support: the simplest that predicts what it never saw as well as any."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.lens import corner_radius
from fieldstone.mapping.model.calibration import (
    ASPECT_SIGMA,
    CalibrationStep,
    richer_steps,
    squareness_error,
    what_is_wrong_with,
    with_free_aspect,
    with_held_center,
)
from fieldstone.mapping.model.refinement import Calibration, RefinementOptions, adjust_globally
from fieldstone.mapping.model.triangulation import covering_tracks, plane_coordinates
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.solve.robust.loss import cauchy
from fieldstone.solve.robust.triangulation import triangulate_robust

logger = logging.getLogger(__name__)

LENS_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
"""From the simplest; the last two are for wide-angle lenses, whose distortion two radial terms do not follow."""
MAX_PULL = 2.0
"""By so many of its standard deviations observations may pull the prior on square pixels."""


@dataclass(frozen=True)
class SelfCalibrationOptions:
    """When a richer model is believed."""

    folds: int = 4
    """The tracks are dealt into so many parts; each judges once and takes no part in the adjustment then."""
    standard_errors: float = 1.0
    """A model is as good as the best if its mean error of prediction is larger by no more than so many standard errors
    of the best's; and the principal point is freed for so many of the difference."""
    min_gain: float = 0.005
    """And in any case if it is larger by this share."""
    principal_point_significance: float = 2.0
    """The principal point is freed if predictions gain by so many standard errors of the mean difference."""
    aspect_standard_errors: float = 3.0
    """Pixels that are not square are believed if predictions gain by so many standard errors of the difference."""
    aspect_gain: float = 0.05
    """And by this share."""
    max_error_px: float = 4.0
    """Predictions that are further off count as just this bad."""
    min_judges: int = 100
    """With fewer tracks nothing is decided, and the calibration stays as it is."""
    enough_judges: int = 3000
    """Once so many tracks have judged the other folds are left out: they only cost time."""
    wide_angle: float = 1.0
    """Half the diagonal over the focal length from which on models for wide-angle lenses are tried."""
    principal_point: bool = True
    """Whether steps that move the principal point are among the candidates."""


@dataclass(frozen=True)
class CalibrationTrial:
    """One candidate: robust root mean square of prediction by the simplest model and by it, and the verdict."""

    step: CalibrationStep
    rms_before_px: float
    rms_after_px: float
    significance: float
    """Of the gain, in standard errors of the mean difference."""
    accepted: bool
    verdict: str
    """Why, or why not."""


def select_camera_models(
    model: WorkingModel, calibration: Calibration, refinement: RefinementOptions, options: SelfCalibrationOptions
) -> tuple[tuple[CalibrationStep | None, ...], list[CalibrationTrial]]:
    """The simplest model that held-out tracks do not speak against, for all cameras that may be refined.

    Every candidate is fitted without the tracks of one fold and predicts their observations, each from the point that
    the others of its track give; every fold has its turn. Of the candidates that are lenses
    (`calibration.what_is_wrong_with`), the simplest is taken whose mean error is within one standard error of the
    least. That error is the best's own, over tracks and photos: it says how far other points and other photos of the
    same camera would move the mean, where the one of the paired difference calls significant what is but a pattern in
    the errors. The principal point is another question, for no camera has
    it in the centre and the prior holds it near: there the paired difference decides.

    Returns:
        The calibration of each camera (None stays None), and every trial.

    Source:
        `breiman1984`, section 3.4.3: the rule of one standard error.
    """
    first = tuple(calibration)
    jury = _jury(model, first, refinement, options)
    if jury is None or all(step is None for step in first):
        return first, []
    held = _tried(first, jury, options)
    lenses = [_tried(lens, jury, options) for lens in _lenses(model, first, options)]
    lenses = _with_proof_of_aspect(lenses, jury, options)
    chosen = _simplest_of_the_best(lenses, jury, options) or held
    candidates = [held, *lenses]
    if options.principal_point and chosen is not held:
        fixed = held if chosen is lenses[0] else _tried(_each(with_held_center, chosen.calibration), jury, options)
        candidates += [] if fixed is held else [fixed]
        gain = _significance(fixed.errors - chosen.errors, jury)
        chosen = fixed if not fixed.wrong and gain < options.standard_errors else chosen
    return chosen.calibration, [_trial(each, held, chosen, model, jury) for each in candidates]


def _each(
    change: Callable[[CalibrationStep], CalibrationStep], calibration: tuple[CalibrationStep | None, ...]
) -> tuple[CalibrationStep | None, ...]:
    """The calibration with every step changed."""
    return tuple(None if step is None else change(step) for step in calibration)


@dataclass(frozen=True, eq=False)
class _Fold:
    """Tracks that judge together: predictions of the observations `rows`, by a model of the tracks `learners`."""

    rows: Int[np.ndarray, "u"]
    predictions: _Predictions
    learners: Bool[np.ndarray, "t"]
    fitted: WorkingModel
    """To the learners, with the simplest calibration."""


@dataclass(frozen=True, eq=False)
class _Jury:
    """All folds, and the track and the photo of every prediction, fold after fold."""

    folds: tuple[_Fold, ...]
    track: Int[np.ndarray, "k"]
    view: Int[np.ndarray, "k"]
    refinement: RefinementOptions


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A calibration of all cameras, and how it predicts what it has not seen."""

    calibration: tuple[CalibrationStep | None, ...]
    errors: Float[np.ndarray, "k"]
    """Robust squared errors of the jury's predictions."""
    wrong: str
    """Why it is not to be believed; "" if it may be."""
    squareness_error: float
    """The largest of its cameras."""

    @property
    def has_free_aspect(self) -> bool:
        """Whether pixels may be of any shape."""
        return self.step.prior.aspect_sigma > ASPECT_SIGMA

    @property
    def step(self) -> CalibrationStep:
        """Of the first camera that is refined."""
        return next(step for step in self.calibration if step is not None)


def _jury(
    model: WorkingModel, calibration: Calibration, refinement: RefinementOptions, options: SelfCalibrationOptions
) -> _Jury | None:
    """Tracks of at least three used observations dealt into folds in the order of their numbers; None if too few."""
    used = model.used_observations()
    long = np.flatnonzero(np.bincount(model.tracks.point[used], minlength=len(model.xyz)) >= 3)
    if len(long) < options.min_judges:
        return None
    folds = []
    for k in range(options.folds):
        if k * len(long) >= options.enough_judges * options.folds:
            break
        judges = np.zeros(len(model.xyz), dtype=bool)
        judges[long[k :: options.folds]] = True
        rows = used[judges[model.tracks.point[used]]]
        learners = covering_tracks(model, refinement.tracks_per_view, ~judges)
        fitted = adjust_globally(model, refinement, calibration, bundle=refinement.final, points=learners)
        folds.append(_Fold(rows, _leave_one_out(model.tracks.point[rows]), learners, fitted))
    rows = np.concatenate([fold.rows for fold in folds])
    return _Jury(tuple(folds), model.tracks.point[rows], model.tracks.view[rows], refinement)


def _tried(calibration: tuple[CalibrationStep | None, ...], jury: _Jury, options: SelfCalibrationOptions) -> _Candidate:
    """A calibration fitted and judged on every fold; what is wrong in one is wrong."""
    loss = cauchy(jury.refinement.final.loss_scale_px)
    errors, wrong, off_square = [], "", 0.0
    for fold in jury.folds:
        fitted = adjust_globally(
            fold.fitted, jury.refinement, calibration, bundle=jury.refinement.final, points=fold.learners
        )
        off_px = prediction_errors(fitted, fold.rows, fold.predictions)
        errors.append(loss(np.minimum(off_px, options.max_error_px) ** 2)[0])
        for camera, step in zip(fitted.cameras, calibration, strict=True):
            if step is not None:
                wrong = wrong or what_is_wrong_with(camera, step)
                off_square = max(off_square, squareness_error(camera, step))
    return _Candidate(calibration, np.concatenate(errors), wrong, off_square)


def _lenses(
    model: WorkingModel, first: tuple[CalibrationStep | None, ...], options: SelfCalibrationOptions
) -> list[tuple[CalibrationStep | None, ...]]:
    """What cameras may become, the simplest first and at least as rich as they are, with the principal point free."""
    wide = any(
        corner_radius(camera) > options.wide_angle for camera, step in zip(model.cameras, first, strict=True) if step
    )
    above = [[] if step is None else richer_steps(step, principal_point=options.principal_point) for step in first]
    out: list[tuple[CalibrationStep | None, ...]] = []
    for lens in LENS_MODELS if wide else LENS_MODELS[:-2]:
        found = tuple(
            next((step for step in reversed(richer) if step.model == lens), old)
            for old, richer in zip(first, above, strict=True)
        )
        if found != first and found not in out:
            out.append(found)
    return out


def _with_proof_of_aspect(lenses: list[_Candidate], jury: _Jury, options: SelfCalibrationOptions) -> list[_Candidate]:
    """Where the prior on square pixels is pulled, the same candidate without it follows the others.

    It is wrong unless it predicts far better than those with square pixels; what is neither square nor free is wrong.
    """
    off = [lens.squareness_error / ASPECT_SIGMA for lens in lenses]
    square = [lens for lens, pull in zip(lenses, off, strict=True) if pull <= MAX_PULL]
    if max(off, default=0.0) <= 1.0 or not square:
        return lenses
    free = _tried(_each(with_free_aspect, lenses[int(np.argmax(off))].calibration), jury, options)
    best = min(square, key=lambda lens: lens.errors.mean())
    gain = best.errors - free.errors
    by_far = gain.mean() > options.aspect_gain * best.errors.mean()
    proven = by_far and _significance(gain, jury) > options.aspect_standard_errors
    why = f"pixels {100 * free.squareness_error:.1f} % from square, without proof"
    out = [
        lens if pull <= MAX_PULL or lens.wrong else replace(lens, wrong=why)
        for lens, pull in zip(lenses, off, strict=True)
    ]
    return [*out, free if proven or free.wrong else replace(free, wrong=why)]


def _simplest_of_the_best(
    lenses: Sequence[_Candidate], jury: _Jury, options: SelfCalibrationOptions
) -> _Candidate | None:
    """The first that may be believed and is as good as the best of them; None if there is none."""
    possible = [lens for lens in lenses if not lens.wrong]
    if not possible:
        return None
    if possible[-1].has_free_aspect:  # proven
        return possible[-1]
    best = min(possible, key=lambda lens: lens.errors.mean())
    error = options.standard_errors * _standard_error(best.errors, jury)
    limit = best.errors.mean() + max(error, options.min_gain * best.errors.mean())
    return next(lens for lens in possible if lens.errors.mean() <= limit)


def _standard_error(values: Float[np.ndarray, "k"], jury: _Jury) -> float:
    """Of the mean of one value per prediction, where those of a track depend on each other and those of a photo too.

    Source:
        `cameron2011`, eq. 2.8: the variance by tracks, plus that by photos, less that by single observations.
    """
    by_track, by_view = (_variance_of_mean(values, cluster) for cluster in (jury.track, jury.view))
    alone = _variance_of_mean(values, np.arange(len(values)))
    return float(np.sqrt(max(by_track + by_view - alone, by_track, by_view)))


def _variance_of_mean(values: Float[np.ndarray, "k"], cluster: Int[np.ndarray, "k"]) -> float:
    """Of values that are independent between clusters only."""
    _, cluster = np.unique(cluster, return_inverse=True)
    off = np.bincount(cluster, values - values.mean())
    return float(np.sum(off**2)) * len(off) / max(len(off) - 1, 1) / len(values) ** 2


def _significance(gain: Float[np.ndarray, "k"], jury: _Jury) -> float:
    """A mean gain in its standard errors."""
    return float(gain.mean() / max(_standard_error(gain, jury), 1e-300))


def _trial(
    candidate: _Candidate, first: _Candidate, chosen: _Candidate, model: WorkingModel, jury: _Jury
) -> CalibrationTrial:
    """What is told of a candidate; errors in pixels of the photos."""
    unit = model.typical_pixel_scale()
    before, after = (unit * float(np.sqrt(each.errors.mean())) for each in (first, candidate))
    significance = _significance(first.errors - candidate.errors, jury) if candidate is not first else 0.0
    if candidate is chosen:
        verdict = "the simplest of the best"
    elif candidate.wrong:
        verdict = candidate.wrong
    else:
        better = candidate.errors.mean() < chosen.errors.mean()
        verdict = "hardly better than a simpler one" if better else "predicts worse"
    step = candidate.step
    logger.info(
        "calibration %s %s: predicts to %.4f px, %+.1f standard errors, %s",
        step.model, "/".join(step.free), after, significance, verdict,
    )  # fmt: skip
    return CalibrationTrial(step, before, after, significance, candidate is chosen, verdict)


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
