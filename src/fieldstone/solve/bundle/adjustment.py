"""Bundle adjustment: Levenberg-Marquardt on poses, points and intrinsics through the Schur complement, compiled.

`bundle_scipy.py` solves the same problem in a page, slowly; `schur.py` is the readable reference of one step.
"""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
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
from fieldstone.solve.bundle.linearize_numba import linearize_points_numba
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.schur_solver import (
    CameraSystem,
    Linearization,
    Values,
    Workers,
    Workspace,
    allocate,
    allocate_linearization,
    camera_system,
    linearize,
    move,
    start_values,
    tile_pattern,
)
from fieldstone.solve.bundle.schur_step import solve_step

logger = logging.getLogger(__name__)

LossName = Literal["trivial", "huber", "soft_l1", "cauchy"]
LOSS_NUMBERS: dict[str, int] = {"trivial": 0, "huber": 1, "soft_l1": 2, "cauchy": 3}
"""How the kernels know the losses of `robust_loss`."""

MIN_DAMPING = 1e-10
"""Keeps the seven free directions of the gauge, and points seen once, away from rounding errors."""
MAX_DAMPING = 1e16
NEGLIGIBLE_COST = 1e-18
"""Cost per observation, in squared pixels, that is nothing but rounding."""
MIN_GAIN = 1e-3
"""A step is taken when the cost falls by at least this share of what the linear model promised."""


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
    """Stop when a step lowers the cost by less than this share of it."""
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


@dataclass(frozen=True, eq=False)
class _Solver:
    """Everything that stays the same during one adjustment."""

    layout: BundleLayout
    pivot: Float[np.ndarray, "3"]
    loss: tuple[int, float]
    priors: PriorRows
    workers: Workers


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
    start = start_values(problem, layout)
    if layout.num_columns + layout.num_border == 0 and not np.any(layout.free_point[layout.point]):
        return BundleResult(problem, 0.0, 0.0, 0, "nothing to refine", usable)
    pool = ThreadPoolExecutor(options.threads) if options.threads > 1 else None
    try:
        solver = _Solver(
            layout,
            np.median(start.points[layout.point_start[1:] > layout.point_start[:-1]], axis=0),
            (LOSS_NUMBERS[options.loss], options.loss_scale_px**2),
            prior_rows(problem, layout, options.camera_priors),
            Workers(pool, options.threads),
        )
        values, costs, iterations, reason = _levenberg_marquardt(solver, start, options)
    finally:
        if pool is not None:
            pool.shutdown()
    logger.info("bundle adjustment: cost %.6g to %.6g in %d steps, %s", costs[0], costs[-1], iterations, reason)
    adjusted = _with_values(problem, layout, values)
    if options.keep_gauge and not (np.any(problem.fixed_views) or np.any(problem.fixed_points)):
        adjusted = _restore_gauge(adjusted, problem, int(layout.listed_view.min()))
    return BundleResult(adjusted, costs[0], costs[-1], iterations, reason, usable, tuple(costs))


def _levenberg_marquardt(
    solver: _Solver, values: Values, options: BundleOptions
) -> tuple[Values, list[float], int, str]:
    """Values at the minimum, the cost after every accepted step, the number of steps tried, the reason to stop."""
    layout, workers = solver.layout, solver.workers
    pattern = tile_pattern(layout)
    work = allocate(layout, pattern)
    at, trial = allocate_linearization(layout), allocate_linearization(layout)
    costs = [linearize(layout, values, solver.loss, at, workers) + solver.priors.cost(values.params)]
    system = _camera_system(solver, values, at, work)
    damping, growth = max(options.initial_damping, MIN_DAMPING), 2.0
    for iteration in range(options.max_iterations):
        step = solve_step(layout, pattern, values, solver.pivot, at, system, damping, work, workers)
        gain = -np.inf
        if step is not None:
            moved, promised = move(layout, values, solver.pivot, at, step, damping, work, workers)
            cost = _evaluate(solver, values, moved, trial)
            gain = (costs[-1] - cost) / promised if promised > 0 else -np.inf
            logger.debug("step %d: cost %.9g, gain %.3f, damping %.2e", iteration, cost, gain, damping)
            smallest = max(options.relative_tolerance * costs[-1], NEGLIGIBLE_COST * len(layout.view))
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
            system = _camera_system(solver, values, at, work)
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > MAX_DAMPING:
                return values, costs, iteration + 1, "no further step lowers the cost"
    return values, costs, options.max_iterations, "iteration limit"


def _camera_system(solver: _Solver, values: Values, at: Linearization, work: Workspace) -> CameraSystem:
    """Normal equations of poses and cameras with priors; parameters that push against a bound are held."""
    system = camera_system(solver.layout, values, solver.pivot, at, work, solver.workers)
    if not len(solver.priors.camera):
        return system
    add_priors(solver.priors, values.params, system)
    held = held_at_bounds(solver.priors, values.params, system)
    if np.any(held):
        drop_columns(solver.priors, held, solver.layout, at)
        system = camera_system(solver.layout, values, solver.pivot, at, work, solver.workers)
        add_priors(solver.priors, values.params, system)
        pin(solver.priors, held, system)
    return system


def _evaluate(solver: _Solver, before: Values, moved: Values, out: Linearization) -> float:
    """Cost after a step, with its linearisation. Points that the step carried behind a camera are put back.

    inf where that does not help, or a focal length is not positive.
    """
    layout = solver.layout
    clip_to_bounds(solver.priors, moved.params)
    if not np.all(moved.params[:, 0] > 0) or not np.all(moved.params[layout.two_focal, 1] > 0):
        return np.inf
    cost = linearize(layout, moved, solver.loss, out, solver.workers)
    if not np.isfinite(cost):
        behind = np.flatnonzero(~np.isfinite(out.cost))
        moved.points[behind] = before.points[behind]
        for p in behind:
            linearize_points_numba(
                p, p + 1, layout.view, layout.point_start, layout.pixels, layout.scale_of_view, layout.camera_of_view,
                layout.model, layout.active, layout.num_active, moved.R, moved.t, moved.points, moved.params,
                *solver.loss, out.B, out.residual, out.J_camera, out.V, out.g_point, out.cost,
            )  # fmt: skip
            if not np.isfinite(out.cost[p]):
                return np.inf
        cost = float(np.sum(out.cost))
    return cost + solver.priors.cost(moved.params)


def in_front(problem: BundleProblem) -> Bool[np.ndarray, "o"]:
    """Observations whose point lies in front of their camera and is finite."""
    depth = np.einsum("oj,oj->o", problem.cam_from_world.R[problem.view, 2], problem.points[problem.point])
    return (depth + problem.cam_from_world.t[problem.view, 2] > 0) & np.isfinite(problem.pixels).all(axis=1)


def _with_values(problem: BundleProblem, layout: BundleLayout, values: Values) -> BundleProblem:
    """The problem at other values; fixed parts keep their bits."""
    points = np.empty_like(values.points)
    points[layout.point_order] = values.points
    R, moved = values.R.copy(), layout.listed_view[: layout.num_slots]
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
