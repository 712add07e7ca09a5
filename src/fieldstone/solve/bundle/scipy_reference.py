"""Bundle adjustment through `scipy.optimize.least_squares`: the textbook solver, and the oracle of the fast one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from fieldstone.geometry.rotation import exp, right_jacobian
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_jacobian, reprojection_residuals, updated
from fieldstone.solve.robust.loss import RobustLoss, robustify, trivial


@dataclass(frozen=True, eq=False)
class ScipyBundleResult:
    """The adjusted problem, costs 0.5 sum rho(|r|^2) before and after, and why the solver stopped."""

    problem: BundleProblem
    initial_cost: float
    final_cost: float
    num_evaluations: int
    reason: str


@dataclass(frozen=True, eq=False)
class _Columns:
    """Where each free parameter stands in the solver's vector; -1 for fixed ones."""

    of_view: Int[np.ndarray, "v 6"]
    of_point: Int[np.ndarray, "p 3"]
    of_camera: Int[np.ndarray, "c k"]
    count: int


def bundle_adjust_scipy(
    problem: BundleProblem,
    *,
    loss: RobustLoss | None = None,
    max_evaluations: int = 100,
    relative_tolerance: float = 1e-8,
) -> ScipyBundleResult:
    """Minimise the robust reprojection error over all free poses, points and intrinsics.

    Trust region reflective with the analytic Jacobian in the sparsity of the visibility matrix: the row of view i
    and point j has entries only in the columns of i, of j and of i's camera. The gauge is free unless views are
    fixed: the trust region keeps the solution near its start.

    Raises:
        ValueError: A point starts behind a camera that sees it.

    Source:
        `triggs2000`; `hartley2004`, appendix 6.
    """
    from scipy.optimize import least_squares  # see `nonlinear`

    loss = loss or trivial()
    columns = _assign_columns(problem)
    if columns.count == 0 or len(problem.view) == 0:
        return ScipyBundleResult(problem, 0.0, 0.0, 0, "nothing to refine")
    behind = np.isnan(reprojection_residuals(problem)).any(axis=1)
    if np.any(behind):
        raise ValueError(f"{int(behind.sum())} observed points are behind their cameras: drop them first")
    indices, row_starts = _sparsity(problem, columns)

    def residuals(x: np.ndarray) -> np.ndarray:
        try:
            moved = _move(problem, columns, x)
        except ValueError:  # a focal length left its range: the trust region shrinks on nan
            return np.full(2 * len(problem.view), np.nan)
        r = reprojection_residuals(moved)
        return robustify(loss, r)[0].ravel()

    def jacobian(x: np.ndarray) -> csr_matrix:
        r, J = reprojection_jacobian(_move(problem, columns, x))
        tangent = _unpack(columns.of_view, x)
        # The solver's unknown is the tangent at the start; J holds derivatives at the current pose.
        rotation_chain = right_jacobian(tangent[:, :3])[problem.view]
        by_omega = J.by_pose[:, :, :3] @ rotation_chain
        by_v = J.by_pose[:, :, 3:] @ np.swapaxes(exp(tangent[:, :3]), 1, 2)[problem.view]
        blocks = np.concatenate([by_omega, by_v, J.by_point, J.by_camera], axis=2)
        blocks = robustify(loss, r)[1] @ blocks
        free = np.repeat(_row_columns(problem, columns) >= 0, 2, axis=0)
        data = blocks.reshape(2 * len(r), -1)[free]
        return csr_matrix((data, indices, row_starts), shape=(2 * len(r), columns.count))

    start = np.zeros(columns.count)
    initial_cost = 0.5 * float(np.sum(residuals(start) ** 2))
    solution = least_squares(
        residuals,
        start,
        jac=jacobian,  # pyright: ignore[reportArgumentType]  # the stubs do not know sparse Jacobians
        method="trf",
        tr_solver="lsmr",
        x_scale="jac",
        ftol=relative_tolerance,
        xtol=1e-12,
        gtol=1e-12,
        max_nfev=max_evaluations,
    )
    return ScipyBundleResult(
        _move(problem, columns, solution.x), initial_cost, float(solution.cost), int(solution.nfev), solution.message
    )


def _assign_columns(problem: BundleProblem) -> _Columns:
    """Number the free parameters: views, then points, then cameras."""
    longest = max(len(camera.params) for camera in problem.cameras)
    refine = np.zeros((len(problem.cameras), longest), dtype=bool)
    for row, mask in zip(refine, problem.refine, strict=True):
        row[: len(mask)] = mask
    free = [
        np.broadcast_to(~problem.fixed_views[:, None], (problem.num_views, 6)),
        np.broadcast_to(~problem.fixed_points[:, None], (len(problem.points), 3)),
        refine,
    ]
    out, count = [], 0
    for mask in free:
        out.append(np.where(mask, count + np.cumsum(mask.ravel()).reshape(mask.shape) - 1, -1))
        count += int(mask.sum())
    return _Columns(out[0], out[1], out[2], count)


def _row_columns(problem: BundleProblem, columns: _Columns) -> Int[np.ndarray, "o k"]:
    """Columns that observation k touches, in the order pose, point, camera; -1 where fixed."""
    return np.concatenate(
        [
            columns.of_view[problem.view],
            columns.of_point[problem.point],
            columns.of_camera[problem.camera_of_view[problem.view]],
        ],
        axis=1,
    )


def _sparsity(
    problem: BundleProblem, columns: _Columns
) -> tuple[Int[np.ndarray, "nnz"], Int[np.ndarray, "rows_and_one"]]:
    """CSR column indices and row starts of the Jacobian: the visibility matrix, two rows per observation."""
    touched = np.repeat(_row_columns(problem, columns), 2, axis=0)
    per_row = np.sum(touched >= 0, axis=1)
    return touched[touched >= 0], np.concatenate([[0], np.cumsum(per_row)])


def _unpack(column: Int[np.ndarray, "n k"], x: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n k"]:
    """Values of the free parameters, 0 for fixed ones."""
    return np.where(column >= 0, x[np.maximum(column, 0)], 0.0)


def _move(problem: BundleProblem, columns: _Columns, x: Float[np.ndarray, "m"]) -> BundleProblem:
    """The problem at the solver's vector x."""
    camera_steps = _unpack(columns.of_camera, x)
    return updated(
        problem,
        _unpack(columns.of_view, x),
        _unpack(columns.of_point, x),
        tuple(step[: len(camera.params)] for step, camera in zip(camera_steps, problem.cameras, strict=True)),
    )
