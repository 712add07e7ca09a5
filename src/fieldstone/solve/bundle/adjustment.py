"""Bundle adjustment: Levenberg-Marquardt on poses, points and intrinsics through the Schur complement, compiled.

`scipy_reference.py` solves the same problem in a page, slowly; `schur.py` is the readable reference of one step.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.solve.bundle.buffers import (
    CameraSystem,
    Linearization,
    Values,
    allocate_linearization,
    start_values,
)
from fieldstone.solve.bundle.camera_prior import (
    CameraPrior,
    PriorRows,
    add_priors,
    clip_to_bounds,
    drop_columns,
    held_at_bounds,
    pin,
    prior_rows,
)
from fieldstone.solve.bundle.layout import BundleLayout, lay_out
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.schur_solver import (
    SchurSolver,
    camera_system,
    linearize,
    linearize_point,
    move,
    schur_solver,
)
from fieldstone.solve.bundle.schur_step import solve_step
from fieldstone.solve.bundle.tile_pattern import tile_pattern
from fieldstone.solve.bundle.workers import started_workers

logger = logging.getLogger(__name__)

LossName = Literal["trivial", "huber", "soft_l1", "cauchy"]
LOSS_NUMBERS: dict[str, int] = {"trivial": 0, "huber": 1, "soft_l1": 2, "cauchy": 3}
"""How the kernels know the losses of `robust.loss`."""

MIN_DAMPING = 1e-10
"""Keeps the seven free directions of the gauge, and points seen once, away from rounding errors."""
MAX_DAMPING = 1e16
NEGLIGIBLE_COST = 1e-18
"""Cost per observation, in squared pixels, that is nothing but rounding."""
MIN_GAIN = 1e-3
"""A step is taken when the cost falls by at least this fraction of what the linear model promised."""


@dataclass(frozen=True)
class BundleOptions:
    """How a bundle is adjusted; the defaults are plain least squares to convergence."""

    loss: LossName = "trivial"
    """Robust loss of the reprojection error."""
    loss_scale_px: float = 1.0
    """Where the loss bends away from least squares, in pixels divided by the view's scale."""
    max_iterations: int = 100
    """Steps tried at most, accepted or not."""
    relative_tolerance: float = 1e-6
    """Stop when a step lowers the cost by less than this fraction of it."""
    initial_damping: float = 1e-4
    """Levenberg-Marquardt factor on the diagonal of the normal equations at the start."""
    keep_gauge: bool = False
    """Where nothing is fixed: afterwards move the whole so that the first view and the scale are as before."""
    camera_priors: tuple[CameraPrior, ...] = ()
    """What is known of intrinsics beforehand: Gaussian priors and bounds."""
    threads: int = 1
    """Number of threads; the result is the same for any number."""

    def __post_init__(self) -> None:
        if self.loss not in LOSS_NUMBERS:
            raise ValueError(f"unknown loss {self.loss!r}; known: {', '.join(LOSS_NUMBERS)}")
        if not self.loss_scale_px > 0:
            raise ValueError(f"loss_scale_px must be positive, got {self.loss_scale_px}")
        if not 0 <= self.relative_tolerance < 1:
            raise ValueError(f"relative_tolerance must lie in [0, 1), got {self.relative_tolerance}")
        if self.max_iterations < 0 or self.threads < 1 or not self.initial_damping > 0:
            raise ValueError("max_iterations must not be negative, threads at least 1, initial_damping positive")

    @property
    def kernel_loss(self) -> tuple[int, float]:
        """Number of the loss and its squared scale, as the kernels take them."""
        return LOSS_NUMBERS[self.loss], self.loss_scale_px**2


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The adjusted problem, and how the solver got there. Costs are 0.5 sum rho(|r|^2) plus the priors' terms."""

    problem: BundleProblem
    initial_cost: float
    final_cost: float
    iterations: int
    """Steps tried."""
    reason: str
    """Why it stopped: "cost settled", "iteration limit", "no further step lowers the cost", "nothing to refine"."""
    usable: Bool[np.ndarray, "o"]
    """Observations that took part: those whose point started in front of its camera."""
    costs: tuple[float, ...] = field(default=())
    """Cost at the start and after every accepted step."""


def bundle_adjust(problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
    """Minimise the robust reprojection error over all free poses, points and intrinsics.

    Steps solve (H + lambda diag H) delta = -g with the right tangent (omega, v) of every pose, turned about the
    median point; lambda follows the ratio of the real to the promised decrease. Robust losses reweight (IRLS). The
    gauge is free unless views or points are fixed: damping then keeps the solution near its start.

    Observations of points that start behind their camera take no part, and no step carries a point behind a camera
    that sees it.

    Source:
        `triggs2000`, sections 6 and 9; `madsen2004`, damping; `agarwal2010`, the Schur complement at scale.
    """
    options = options or BundleOptions()
    usable = in_front(problem)
    layout = lay_out(problem, usable)
    if layout.num_columns + layout.num_shared == 0 and not np.any(layout.free_point[layout.point_of_obs]):
        return BundleResult(problem, 0.0, 0.0, 0, "nothing to refine", usable)
    priors = prior_rows(problem, layout, options.camera_priors)
    with started_workers(options.threads) as workers:
        solver = schur_solver(layout, tile_pattern(layout), options.kernel_loss, workers)
        values, costs, iterations, reason = _levenberg_marquardt(solver, priors, start_values(problem, layout), options)
    logger.info("bundle adjustment: cost %.6g to %.6g in %d steps, %s", costs[0], costs[-1], iterations, reason)
    adjusted = _with_values(problem, layout, values)
    if options.keep_gauge and not (np.any(problem.fixed_views) or np.any(problem.fixed_points)):
        adjusted = _restore_gauge(adjusted, problem, int(layout.view_order.min()))
    return BundleResult(adjusted, costs[0], costs[-1], iterations, reason, usable, tuple(costs))


def _levenberg_marquardt(
    solver: SchurSolver, priors: PriorRows, values: Values, options: BundleOptions
) -> tuple[Values, list[float], int, str]:
    """Values at the minimum, the cost after every accepted step, the number of steps tried, the reason to stop."""
    layout = solver.layout
    at, trial = allocate_linearization(layout), allocate_linearization(layout)
    costs = [linearize(solver, values, at) + priors.cost(values.params)]
    system = _camera_system(solver, priors, values, at)
    damping, growth = max(options.initial_damping, MIN_DAMPING), 2.0
    for iteration in range(options.max_iterations):
        step = solve_step(solver, values, at, system, damping)
        gain = -np.inf
        if step is not None:
            moved, promised = move(solver, values, at, step, damping)
            cost = _evaluate(solver, priors, values, moved, trial)
            gain = (costs[-1] - cost) / promised if promised > 0 else -np.inf
            logger.debug("step %d: cost %.9g, gain %.3f, damping %.2e", iteration, cost, gain, damping)
            smallest = max(options.relative_tolerance * costs[-1], NEGLIGIBLE_COST * len(layout.view_of_obs))
            settled = max(promised, abs(costs[-1] - cost)) <= smallest
            if gain > MIN_GAIN:
                settled = costs[-1] - cost <= smallest
                values, at, trial = moved, trial, at
                costs.append(cost)
            if settled:
                return values, costs, iteration + 1, "cost settled"
        if gain > MIN_GAIN:
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), MIN_DAMPING)
            growth = 2.0
            system = _camera_system(solver, priors, values, at)
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > MAX_DAMPING:
                return values, costs, iteration + 1, "no further step lowers the cost"
    return values, costs, options.max_iterations, "iteration limit"


def _camera_system(solver: SchurSolver, priors: PriorRows, values: Values, at: Linearization) -> CameraSystem:
    """Normal equations of poses and intrinsics with priors; parameters that push against a bound are held."""
    system = camera_system(solver, values, at)
    if not len(priors.camera):
        return system
    add_priors(priors, values.params, system)
    held = held_at_bounds(priors, values.params, system)
    if np.any(held):
        drop_columns(priors, held, solver.layout, at)
        system = camera_system(solver, values, at)
        add_priors(priors, values.params, system)
        pin(priors, held, system)
    return system


def _evaluate(solver: SchurSolver, priors: PriorRows, before: Values, moved: Values, out: Linearization) -> float:
    """Cost after a step, with its linearisation. Points that the step carried behind a camera are put back.

    inf where that does not help, or a focal length is not positive.
    """
    clip_to_bounds(priors, moved.params)
    if not np.all(moved.params[:, 0] > 0) or not np.all(moved.params[solver.layout.two_focal, 1] > 0):
        return np.inf
    cost = linearize(solver, moved, out)
    if not np.isfinite(cost):
        behind = np.flatnonzero(~np.isfinite(out.cost))
        moved.points[behind] = before.points[behind]
        for p in behind.tolist():
            if not np.isfinite(linearize_point(solver, moved, p, out)):
                return np.inf
        cost = float(np.sum(out.cost))
    return cost + priors.cost(moved.params)


def in_front(problem: BundleProblem) -> Bool[np.ndarray, "o"]:
    """Observations whose point lies in front of their camera and is finite."""
    depth = np.einsum("oj,oj->o", problem.cam_from_world.R[problem.view, 2], problem.points[problem.point])
    return (depth + problem.cam_from_world.t[problem.view, 2] > 0) & np.isfinite(problem.pixels).all(axis=1)


def _with_values(problem: BundleProblem, layout: BundleLayout, values: Values) -> BundleProblem:
    """The problem at other values; fixed parts keep their bits."""
    points = np.empty_like(values.points)
    points[layout.point_order] = values.points
    R, moved = values.R.copy(), layout.view_order[: layout.num_free_views]
    R[moved] = nearest_rotation(R[moved])  # or the rounding of many adjustments adds up
    cameras = tuple(
        replace(camera, params=row[: len(camera.params)].copy()) if mask.any() else camera
        for camera, row, mask in zip(problem.cameras, values.params, problem.refine, strict=True)
    )
    return replace(problem, cameras=cameras, cam_from_world=Rigid3(R, values.t), points=points)


def _restore_gauge(adjusted: BundleProblem, before: BundleProblem, view: int) -> BundleProblem:
    """Move the world so that `view` has its old pose and the farthest view from it its old distance."""
    old_centers = before.cam_from_world.target_origin_in_source()
    new_centers = adjusted.cam_from_world.target_origin_in_source()
    old_distance = np.linalg.norm(old_centers - old_centers[view], axis=1)
    far = int(np.argmax(old_distance))
    new_distance = float(np.linalg.norm(new_centers[far] - new_centers[view]))
    scale = float(old_distance[far]) / new_distance if new_distance > 0 else 1.0
    in_view = adjusted.cam_from_world[view].apply(adjusted.points) * scale
    view_from_new = adjusted.cam_from_world[view]
    cam_from_view = adjusted.cam_from_world @ view_from_new.inverse()
    cam_from_old = Rigid3(cam_from_view.R, scale * cam_from_view.t) @ before.cam_from_world[view]
    cam_from_old = Rigid3(nearest_rotation(cam_from_old.R), cam_from_old.t)
    points = before.cam_from_world[view].inverse().apply(in_view)
    return replace(adjusted, cam_from_world=cam_from_old, points=points)
