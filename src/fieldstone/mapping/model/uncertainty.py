"""How well a finished model is determined: covariances of its poses and points from the last adjustment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rotation import skew
from fieldstone.mapping.model.calibration import priors
from fieldstone.mapping.model.refinement import Calibration, RefinementOptions, bundle_problem
from fieldstone.mapping.model.working_model import WorkingModel, reprojections
from fieldstone.scene.mapping_run import Uncertainty
from fieldstone.solve.bundle.adjustment import BundleOptions
from fieldstone.solve.bundle.covariance import bundle_covariance
from fieldstone.solve.robust.loss import RobustLoss, cauchy, huber, soft_l1, trivial

LOSSES: dict[str, Callable[[float], RobustLoss]] = {
    "trivial": lambda _: trivial(), "huber": huber, "soft_l1": soft_l1, "cauchy": cauchy
}  # fmt: skip


def model_uncertainty(model: WorkingModel, calibration: Calibration, options: RefinementOptions) -> Uncertainty:
    """The covariances at the minimum that `refine_until_stable` has found, in the gauge of least variance.

    Raises:
        ValueError: The model has so many photos that the dense inverse would not fit, or is not determined.
    """
    problem, registered, _ = bundle_problem(
        model, model.is_point(), model.registered, calibration, options.min_views_for_intrinsics
    )
    errors = reprojections(model).scaled_errors
    freedoms = 2 * len(errors) - 6 * len(registered) - 3 * len(problem.points) + 7
    freedoms -= int(sum(mask.sum() for mask in problem.refine))
    sigma = float(np.sqrt(np.sum(errors**2) / max(freedoms, 1)))
    bundle = replace(options.final, camera_priors=priors(problem.cameras, calibration))
    found = bundle_covariance(problem, bundle, sigma_px=sigma * robust_factor(errors, bundle))
    of_views = np.full((model.num_views, 6, 6), np.nan)
    of_views[registered] = found.of_views
    rotation = np.rad2deg(np.sqrt(np.trace(of_views[:, :3, :3], axis1=1, axis2=2)))
    sigma_px = sigma * model.typical_pixel_scale()
    return Uncertainty(of_views, found.of_points, sigma_px, rotation, _of_centers(model, of_views))


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
