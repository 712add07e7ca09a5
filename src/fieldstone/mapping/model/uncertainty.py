"""How well a finished model is determined: covariances of poses, points and intrinsics from the last adjustment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rotation import skew
from fieldstone.mapping.model.calibration import PRINCIPAL_POINT_SIGMA, CalibrationStep, priors, what_is_wrong_with
from fieldstone.mapping.model.refinement import Calibration, RefinementOptions, bundle_problem
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.records.mapping import CameraCertainty
from fieldstone.scene.mapping_run import Uncertainty
from fieldstone.solve.bundle.adjustment import BundleOptions
from fieldstone.solve.bundle.covariance import bundle_covariance
from fieldstone.solve.bundle.intrinsics_covariance import intrinsics_covariance
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_residuals
from fieldstone.solve.robust.loss import RobustLoss, cauchy, huber, soft_l1, trivial

LOSSES: dict[str, Callable[[float], RobustLoss]] = {
    "trivial": lambda _: trivial(), "huber": huber, "soft_l1": soft_l1, "cauchy": cauchy
}  # fmt: skip

MIN_PHOTOS = 3
"""What fewer photos have in common is their camera's, for all that they tell."""
MAX_PHOTOS = 200
"""Photos that the certainty of intrinsics is computed from."""
MAX_FOCAL_SD = 0.003
"""A focal length that is less certain is weakly determined: it moves the corners of a photo by pixels."""
MAX_CENTER_SHARE = 0.5
"""A principal point whose standard deviation is a larger share of that of its prior is as good as assumed."""


def model_uncertainty(model: WorkingModel, calibration: Calibration, options: RefinementOptions) -> Uncertainty:
    """The covariances at the minimum that `refine_until_stable` has found, in the gauge of least variance.

    Raises:
        ValueError: The model has so many photos that the dense inverse would not fit, or is not determined.
    """
    problem, registered, _ = bundle_problem(
        model, model.is_point(), model.registered, calibration, options.min_views_for_intrinsics
    )
    sigma, errors = _noise(problem)
    bundle = replace(options.final, camera_priors=priors(problem.cameras, calibration))
    found = bundle_covariance(problem, bundle, sigma_px=sigma * robust_factor(errors, bundle))
    of_views = np.full((model.num_views, 6, 6), np.nan)
    of_views[registered] = found.of_views
    rotation = np.rad2deg(np.sqrt(np.trace(of_views[:, :3, :3], axis1=1, axis2=2)))
    sigma_px = sigma * model.typical_pixel_scale()
    return Uncertainty(of_views, found.of_points, sigma_px, rotation, _of_centers(model, of_views))


def camera_certainties(
    model: WorkingModel, calibration: Calibration, options: RefinementOptions
) -> tuple[CameraCertainty, ...]:
    """Of every camera: a standard deviation for each intrinsic that was refined, and a word.

    Poses and points are eliminated, and errors may depend on each other within photos and points, see
    `intrinsics_covariance`. Of large models so many photos say as much as is needed.
    """
    part = _part_of(model, MAX_PHOTOS)
    problem, _, _ = bundle_problem(
        part, part.is_point(), part.registered, calibration, options.min_views_for_intrinsics
    )
    sigma, errors = _noise(problem)
    bundle = replace(options.final, camera_priors=priors(problem.cameras, calibration))
    sds = [np.full(len(camera.params), np.nan) for camera in model.cameras]
    wrong = ""
    if any(mask.any() for mask in problem.refine):
        try:
            loss = LOSSES[bundle.loss](bundle.loss_scale_px)
            found = intrinsics_covariance(problem, bundle, loss, sigma_px=sigma * robust_factor(errors, bundle))
        except ValueError as error:
            wrong = str(error)
        else:
            for c, k, sd in zip(found.camera, found.param, found.standard_deviations(), strict=True):
                sds[c][k] = sd
    photos = np.bincount(model.camera_of_view[model.registered], minlength=len(model.cameras))
    few = [f"refined from {n} photos only" if 0 < n < MIN_PHOTOS else "" for n in photos.tolist()]
    nothing = CameraCertainty((), "assumed", "too few of its photos are in the model to refine it")
    return tuple(
        _certainty(camera, step, sd, wrong or fewer)
        if step is None or mask.any()
        else replace(nothing, sds=(None,) * len(sd))
        for camera, step, sd, fewer, mask in zip(model.cameras, calibration, sds, few, problem.refine, strict=True)
    )


def _certainty(camera: Camera, step: CalibrationStep | None, sd: Float[np.ndarray, "p"], wrong: str) -> CameraCertainty:
    """The word for one camera, and why: its parameters are held, little is known of them, or enough.

    Args:
        wrong: Why they are not to be relied on, whatever their standard deviations; "" if there is nothing.
    """
    known = tuple(None if np.isnan(value) else float(value) for value in sd)
    if step is None:
        return CameraCertainty(known, "assumed", "given as exact")
    focal = float(np.nanmax(sd[: camera.spec.num_focal] / camera.focal[: camera.spec.num_focal], initial=0.0))
    center = np.nan_to_num(sd[camera.spec.num_focal : camera.spec.num_focal + 2]).max()
    center_limit = MAX_CENTER_SHARE * PRINCIPAL_POINT_SIGMA * max(camera.width, camera.height)
    if wrong := wrong or what_is_wrong_with(camera, step):
        return CameraCertainty(known, "weak", wrong)
    if focal > MAX_FOCAL_SD:
        return CameraCertainty(known, "weak", f"focal length known to {100 * focal:.2g} % only")
    if center > center_limit:
        return CameraCertainty(known, "weak", f"principal point known to {center:.2g} px only")
    return CameraCertainty(known, "well determined", f"focal length known to {100 * focal:.2g} %")


def _part_of(model: WorkingModel, max_photos: int) -> WorkingModel:
    """The model with so many of its photos at most, spread over their order, and the points that two of them see."""
    registered = np.flatnonzero(model.registered)
    if len(registered) <= max_photos:
        return model
    keep = np.zeros(model.num_views, dtype=bool)
    keep[registered[np.linspace(0, len(registered) - 1, max_photos).round().astype(int)]] = True
    part = model.only_registered(keep)
    seen = np.bincount(part.tracks.point[part.used_observations()], minlength=len(part.xyz))
    return replace(part, xyz=np.where((seen >= 2)[:, None], part.xyz, np.nan))


def _noise(problem: BundleProblem) -> tuple[float, Float[np.ndarray, "k"]]:
    """Standard deviation of an observation per axis over the pixel scales, and the errors that tell it."""
    errors = np.linalg.norm(reprojection_residuals(problem), axis=1)
    errors = errors[np.isfinite(errors)]
    freedoms = 2 * len(errors) - 6 * problem.num_views - 3 * len(problem.points) + 7
    freedoms -= int(sum(mask.sum() for mask in problem.refine))
    return float(np.sqrt(np.sum(errors**2) / max(freedoms, 1))), errors


def robust_factor(errors_px: Float[np.ndarray, "o"], options: BundleOptions) -> float:
    """By what to multiply the noise so that the inverse of J^T W J, W the weights of a robust loss, is a covariance.

    The covariance of an M-estimator is b / a^2 (J^T J)^-1, with b = E psi^2 and a = E psi', and J^T W J is about
    E w J^T J: without the factor what a loss takes from ordinary observations would count as missing.

    Source:
        `huber1981`, section 7.6.
    """
    squared = errors_px**2
    loss = LOSSES[options.loss](options.loss_scale_px)
    weight = loss(squared)[1]
    step = 1e-4
    slope = weight + (loss(squared * (1 + step))[1] - weight) / step  # half the divergence of weight * residual
    share = np.mean(weight**2 * squared) * np.mean(weight) / max(float(np.mean(squared)), 1e-300)
    return float(np.sqrt(share) / np.mean(slope))


def _of_centers(model: WorkingModel, of_views: Float[np.ndarray, "v 6 6"]) -> Float[np.ndarray, "v"]:
    """Standard deviation of each camera's centre c = -R^T t, which (omega, v) moves by c x omega - v in the world."""
    out = np.full(len(of_views), np.nan)
    for v in np.flatnonzero(model.registered).tolist():
        J = np.concatenate([skew(model.pose_of(v).target_origin_in_source()), -np.eye(3)], axis=1)
        out[v] = np.sqrt(np.trace(J @ of_views[v] @ J.T))
    return out
