"""One damped step of bundle adjustment through the Schur complement, on the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldstone.solve.bundle.buffers import (
    CameraSystem,
    Linearization,
    ReducedSystem,
    SolverBuffers,
    Step,
    Values,
    allocate_buffers,
    zero_camera_system,
)
from fieldstone.solve.bundle.layout import BundleLayout
from fieldstone.solve.bundle.linearize_numba import gather_cameras_numba, linearize_points_numba, linearize_views_numba
from fieldstone.solve.bundle.schur_numba import (
    eliminate_points_numba,
    move_points_numba,
    move_views_numba,
    reduce_corner_numba,
    reduce_rows_numba,
)
from fieldstone.solve.bundle.tile_pattern import TilePattern
from fieldstone.solve.bundle.workers import Workers


@dataclass(frozen=True, eq=False)
class SchurSolver:
    """What stays the same during one adjustment; the buffers are written anew by every step."""

    layout: BundleLayout
    pattern: TilePattern
    loss: tuple[int, float]
    """Number of the loss, and its squared scale."""
    buffers: SolverBuffers
    workers: Workers


def schur_solver(layout: BundleLayout, pattern: TilePattern, loss: tuple[int, float], workers: Workers) -> SchurSolver:
    """A solver with buffers of its own."""
    return SchurSolver(layout, pattern, loss, allocate_buffers(layout, pattern), workers)


def linearize(solver: SchurSolver, values: Values, out: Linearization) -> float:
    """Fill `out` with residuals, Jacobians and point blocks; returns the cost, inf if a point is behind a camera."""
    layout, workers = solver.layout, solver.workers
    workers.over(linearize_points_numba, workers.split(layout.point_start), layout, values, solver.loss, out)
    return float(np.sum(out.cost))


def linearize_point(solver: SchurSolver, values: Values, point: int, out: Linearization) -> float:
    """The same for a single point: its cost."""
    linearize_points_numba(point, point + 1, solver.layout, values, solver.loss, out)
    return float(out.cost[point])


def camera_system(solver: SchurSolver, values: Values, at: Linearization) -> CameraSystem:
    """Normal equations of poses and intrinsics, sorted into free views and shared intrinsics."""
    layout, workers = solver.layout, solver.workers
    workers.over(linearize_views_numba, workers.split(layout.view_start), layout, values, at, solver.buffers)
    system = zero_camera_system(layout)
    gather_cameras_numba(layout, solver.buffers, system)
    return system


def reduce_system(
    solver: SchurSolver, values: Values, at: Linearization, system: CameraSystem, damping: float
) -> ReducedSystem:
    """Eliminate the points: the damped reduced camera system, in the solver's buffers."""
    layout, workers, buffers, reduced = solver.layout, solver.workers, solver.buffers, solver.buffers.reduced
    workers.over(eliminate_points_numba, workers.split(layout.point_start), layout, at, damping, buffers)
    rows = [(k, layout.num_free_views, workers.threads) for k in range(workers.threads)]
    workers.over(reduce_rows_numba, rows, layout, solver.pattern.given_index, values, system, damping, buffers)
    reduced.corner[:] = system.corner + damping * np.diag(np.diag(system.corner))
    reduced.rhs_shared[:] = -system.g_shared
    if layout.num_shared:
        reduce_corner_numba(layout, buffers)
    return reduced


def move(solver: SchurSolver, values: Values, at: Linearization, step: Step, damping: float) -> tuple[Values, float]:
    """The values after a step, and the decrease of the cost that the linear model promised."""
    layout, workers, buffers = solver.layout, solver.workers, solver.buffers
    moved = Values(values.R.copy(), values.t.copy(), np.empty_like(values.points), values.params.copy())
    move_views_numba(layout, values, step, moved)
    _move_intrinsics(layout, step, moved)
    workers.over(
        move_points_numba, workers.split(layout.point_start), layout, values, at, damping, step, buffers, moved
    )
    return moved, step.decrease + float(np.sum(buffers.decrease))


def _move_intrinsics(layout: BundleLayout, step: Step, moved: Values) -> None:
    """Add the steps of shared and of per-view intrinsics, in place."""
    params = moved.params
    for c in np.flatnonzero(layout.shared_row >= 0):
        a, first = int(layout.num_refined[c]), int(layout.shared_row[c])
        params[c, layout.refined[c, :a]] += step.dx_shared[first : first + a]
    if layout.block > 6:
        camera = layout.camera_of_view[layout.view_order[: layout.num_free_views]]
        for i in np.flatnonzero(layout.per_view[camera]):
            a = int(layout.num_refined[camera[i]])
            params[camera[i], layout.refined[camera[i], :a]] += step.dx[i, 6 : 6 + a]
