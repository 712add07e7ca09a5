"""Non-linear triangulation and non-linear PnP: minimise the true reprojection error with a robust loss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.jacobian import image_from_world_jacobian
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp, right_jacobian
from fieldstone.solve.robust.loss import RobustLoss, robustify, trivial


def triangulate_nonlinear(
    cameras: Sequence[Camera],
    camera_of_view: Int[np.ndarray, "v"],
    cam_from_world: Rigid3,
    view: Int[np.ndarray, "o"],
    point: Int[np.ndarray, "o"],
    pixels: Float[np.ndarray, "o 2"],
    start: Float[np.ndarray, "p 3"],
    *,
    loss: RobustLoss | None = None,
    max_iterations: int = 30,
) -> Float[np.ndarray, "p 3"]:
    """Points that minimise the robust reprojection error in all their views, poses fixed.

    Every point is a problem of its own with 3 unknowns: Levenberg-Marquardt on all of them together, each with its
    own damping and its own acceptance. A point that starts behind one of its cameras, or at infinity, stays there.

    Source:
        `hartley2004`, section 12.3 (the error) and appendix 6.2 (Levenberg-Marquardt).
    """
    loss = loss or trivial()
    X = start.copy()
    damping = np.full(len(X), 1e-4)
    cost = _cost_per_point(cameras, camera_of_view, cam_from_world, view, point, pixels, X, loss)
    active = np.isfinite(cost)
    for _ in range(max_iterations):
        if not active.any():
            break
        rows = active[point]
        A, g = _normal_equations(
            cameras, camera_of_view, cam_from_world, view[rows], point[rows], pixels[rows], X, loss
        )
        diagonal = np.einsum("pii->pi", A)
        A = A + np.einsum("pi,ij->pij", damping[:, None] * diagonal + 1e-12 * diagonal.max(axis=1)[:, None], np.eye(3))
        A[~active] = np.eye(3)
        step = -np.linalg.solve(A, g[..., None])[..., 0]
        trial = np.where(active[:, None], X + step, X)
        trial_cost = _cost_per_point(cameras, camera_of_view, cam_from_world, view, point, pixels, trial, loss)
        better = active & (trial_cost < cost)
        gain = np.where(better, cost, 0.0) - np.where(better, trial_cost, 0.0)
        X[better] = trial[better]
        active &= ~(better & (gain <= 1e-10 * np.where(better, cost, 1.0))) & (damping < 1e8)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, np.maximum(damping * 0.2, 1e-10), damping * 8.0)
    return X


def pnp_nonlinear(
    camera: Camera,
    cam_from_world: Rigid3,
    pixels: Float[np.ndarray, "n 2"],
    points_in_world: Float[np.ndarray, "n 3"],
    *,
    loss: RobustLoss | None = None,
) -> Rigid3:
    """The pose that minimises the robust reprojection error, points fixed.

    Points that start behind the camera are left out.

    Raises:
        ValueError: Fewer than 3 points lie in front of the camera.

    Source:
        `hartley2004`, section 7.2.
    """
    from scipy.optimize import least_squares  # slow to import, and the default mapper does without it

    loss = loss or trivial()
    usable = cam_from_world.apply(points_in_world)[:, 2] > 0
    if usable.sum() < 3:
        raise ValueError(f"non-linear PnP needs 3 points in front of the camera, got {int(usable.sum())}")
    X, observed = points_in_world[usable], pixels[usable]

    def residuals(tangent: np.ndarray) -> np.ndarray:
        return robustify(loss, image_from_cam(camera, cam_from_world.retract(tangent).apply(X)) - observed)[0].ravel()

    def jacobian(tangent: np.ndarray) -> np.ndarray:
        pose = cam_from_world.retract(tangent)
        J = image_from_world_jacobian(camera, pose, X)
        by_omega = J.by_pose[:, :, :3] @ right_jacobian(tangent[:3])
        by_v = J.by_pose[:, :, 3:] @ exp(tangent[:3]).T
        chain = robustify(loss, J.pixels - observed)[1]
        return (chain @ np.concatenate([by_omega, by_v], axis=2)).reshape(-1, 6)

    solution = least_squares(residuals, np.zeros(6), jac=jacobian, method="trf", x_scale="jac", ftol=1e-12)  # pyright: ignore[reportArgumentType]
    return cam_from_world.retract(solution.x)


def _cost_per_point(
    cameras: Sequence[Camera],
    camera_of_view: Int[np.ndarray, "v"],
    cam_from_world: Rigid3,
    view: Int[np.ndarray, "o"],
    point: Int[np.ndarray, "o"],
    pixels: Float[np.ndarray, "o 2"],
    X: Float[np.ndarray, "p 3"],
    loss: RobustLoss,
) -> Float[np.ndarray, "p"]:
    """Robust cost of each point; inf where it lies behind one of its cameras."""
    in_cam = cam_from_world[view].apply(X[point])
    errors2 = np.full(len(view), np.inf)
    for rows, camera in _rows_by_camera(cameras, camera_of_view, view):
        difference = image_from_cam(camera, in_cam[rows]) - pixels[rows]
        errors2[rows] = np.nan_to_num(np.sum(difference**2, axis=1), nan=np.inf, posinf=np.inf)
    finite = np.isfinite(errors2)
    rho = np.where(finite, loss(np.where(finite, errors2, 0.0))[0], np.inf)
    return np.bincount(point, weights=rho, minlength=len(X)).astype(np.float64)  # integers where there is none


def _normal_equations(
    cameras: Sequence[Camera],
    camera_of_view: Int[np.ndarray, "v"],
    cam_from_world: Rigid3,
    view: Int[np.ndarray, "o"],
    point: Int[np.ndarray, "o"],
    pixels: Float[np.ndarray, "o 2"],
    X: Float[np.ndarray, "p 3"],
    loss: RobustLoss,
) -> tuple[Float[np.ndarray, "p 3 3"], Float[np.ndarray, "p 3"]]:
    """Sum of w J^T J and w J^T r over the observations of each point, w the robust weight."""
    pose = cam_from_world[view]
    residuals, J = np.empty((len(view), 2)), np.empty((len(view), 2, 3))
    for rows, camera in _rows_by_camera(cameras, camera_of_view, view):
        image = image_from_world_jacobian(camera, pose[rows], X[point[rows]])
        residuals[rows] = image.pixels - pixels[rows]
        J[rows] = image.by_point
    weight = loss(np.sum(residuals**2, axis=1))[1]
    A, g = np.zeros((len(X), 3, 3)), np.zeros((len(X), 3))
    np.add.at(A, point, weight[:, None, None] * (np.swapaxes(J, 1, 2) @ J))
    np.add.at(g, point, weight[:, None] * np.einsum("oij,oi->oj", J, residuals))
    return A, g


def _rows_by_camera(
    cameras: Sequence[Camera], camera_of_view: Int[np.ndarray, "v"], view: Int[np.ndarray, "o"]
) -> list[tuple[Bool[np.ndarray, "o"], Camera]]:
    """Mask of the observations of each camera that has any."""
    masks = [(camera_of_view[view] == c, camera) for c, camera in enumerate(cameras)]
    return [(mask, camera) for mask, camera in masks if mask.any()]
