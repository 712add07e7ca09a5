"""Refinement of parts of a bundle problem: points with cameras held, or one camera with points held."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.solve.bundle.adjustment import LOSS_NUMBERS, BundleOptions, BundleResult, bundle_adjust, in_front
from fieldstone.solve.bundle.layout import lay_out
from fieldstone.solve.bundle.point_refinement_numba import refine_points_numba
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.schur_solver import Workers, allocate_linearization, linearize, start_values


def refine_points(problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
    """Minimise the robust reprojection error over the free points alone; poses and intrinsics are held.

    Every point is solved by itself, so one that converges slowly does not hold up the others. Observations of
    points that start behind their camera take no part; priors of cameras say nothing here.

    Source:
        `hartley2004`, section 12.3, for the objective; `triggs2000`, section 4.3, for the reweighting.
    """
    options = options or BundleOptions()
    usable = in_front(problem)
    held = replace(
        problem,
        fixed_views=np.ones(problem.num_views, dtype=bool),
        refine=tuple(np.zeros_like(mask) for mask in problem.refine),
    )
    layout = lay_out(held, usable)
    values, at, trial = start_values(held, layout), allocate_linearization(layout), allocate_linearization(layout)
    pool = ThreadPoolExecutor(options.threads) if options.threads > 1 else None
    workers = Workers(pool, options.threads)
    loss = (LOSS_NUMBERS[options.loss], options.loss_scale_px**2)
    try:
        initial_cost = linearize(layout, values, loss, at, workers)
        workers.over(
            refine_points_numba, workers.split(layout.point_start),
            layout.view, layout.point_start, layout.pixels, layout.scale_of_view, layout.camera_of_view,
            layout.model, layout.active, layout.num_active, values.R, values.t, values.points, values.params, *loss,
            options.max_iterations, options.relative_tolerance, layout.free_point,
            at.B, at.residual, at.J_camera, at.V, at.g_point, at.cost,
            np.empty_like(values.points), trial.V, trial.g_point, trial.cost,
        )  # fmt: skip
    finally:
        if pool is not None:
            pool.shutdown()
    points = np.empty_like(values.points)
    points[layout.point_order] = values.points
    final_cost = float(np.sum(at.cost))
    refined = replace(problem, points=points)
    return BundleResult(refined, initial_cost, final_cost, options.max_iterations, "every point settled", usable)


def refine_pose(
    camera: Camera,
    cam_from_world: Rigid3,
    points: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    options: BundleOptions | None = None,
    *,
    refine: Bool[np.ndarray, "k"] | None = None,
) -> tuple[Rigid3, Camera, BundleResult]:
    """Minimise the robust reprojection error of one view over its pose, and over the camera parameters in `refine`.

    Args:
        refine: Mask of the camera's parameters; all are held by default.
    """
    count = len(points)
    problem = BundleProblem(
        cameras=(camera,),
        camera_of_view=np.zeros(1, dtype=np.int64),
        cam_from_world=Rigid3(cam_from_world.R[None], cam_from_world.t[None]),
        points=points,
        view=np.zeros(count, dtype=np.int64),
        point=np.arange(count),
        pixels=pixels,
        fixed_views=np.zeros(1, dtype=bool),
        fixed_points=np.ones(count, dtype=bool),
        refine=(np.zeros(len(camera.params), dtype=bool) if refine is None else refine,),
    )
    result = bundle_adjust(problem, options)
    return result.problem.cam_from_world[0], result.problem.cameras[0], result
