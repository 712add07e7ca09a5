"""The reduced camera system of many photos, solved without being formed: conjugate gradients through the points.

S x = (U + damping diag U) x - sum over points of Z^T (Z x), two passes over the observations. The preconditioner is
the block diagonal of S, a block being some neighbouring views.

Source:
    `agarwal2010`, sections 3 and 4.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.solve.algebra.conjugate_gradients import conjugate_gradients
from fieldstone.solve.algebra.tile_cholesky_numba import factor_numba
from fieldstone.solve.bundle.buffers import CameraSystem, Values
from fieldstone.solve.bundle.schur_pcg_numba import points_of_views_numba, views_of_points_numba
from fieldstone.solve.bundle.schur_solver import SchurSolver

TOLERANCE = 0.1
"""How far the residual falls for one step; a better solution hardly makes a better step."""
MAX_ITERATIONS = 500


def solve_iteratively(
    solver: SchurSolver, values: Values, system: CameraSystem, damping: float, *, tolerance: float
) -> tuple[Float[np.ndarray, "s b"], Float[np.ndarray, "n"]] | None:
    """Steps of the free views and of shared intrinsics; None where the system is not positive definite.

    Of the reduced system in the solver's buffers, the tiles are those of its block diagonal.
    """
    layout, pattern, buffers, workers = solver.layout, solver.pattern, solver.buffers, solver.workers
    tiles, border, rhs, lower_corner, rhs_shared = buffers.reduced
    n, (s, b) = len(border), rhs.shape
    count, size = len(pattern.index), pattern.per_tile * b
    if not factor_numba(tiles, pattern.index, buffers.L, buffers.diagonal_inverse, s, np.empty((count, 0, size))):
        return None
    corner = np.tril(lower_corner) + np.tril(lower_corner, -1).T
    try:
        corner_inverse = np.linalg.inv(np.linalg.cholesky(corner)) if n else corner
    except np.linalg.LinAlgError:
        return None
    w = np.empty((len(layout.free_point), 3))
    of_points, of_views = workers.split(layout.point_start), workers.split(layout.view_start[: s + 1])

    def apply(x: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        views, out = x[: s * b].reshape(s, b), np.empty((s, b))
        workers.over(points_of_views_numba, of_points, layout, values, buffers.Z, views, w)
        workers.over(views_of_points_numba, of_views, layout, values, buffers.Z, system.U, damping, views, w, out)
        out += np.einsum("nsb,n->sb", border, x[s * b :])
        return np.concatenate([out.ravel(), np.einsum("nsb,sb->n", border, views) + corner @ x[s * b :]])

    def precondition(r: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        padded = np.zeros((count, size))
        padded.ravel()[: s * b] = r[: s * b]
        half = np.einsum("tij,tj->ti", buffers.diagonal_inverse, padded)
        whole = np.einsum("tij,ti->tj", buffers.diagonal_inverse, half)
        return np.concatenate([whole.ravel()[: s * b], corner_inverse.T @ (corner_inverse @ r[s * b :])])

    solution = conjugate_gradients(
        apply,
        np.concatenate([rhs.ravel(), rhs_shared]),
        precondition,
        tolerance=tolerance,
        max_iterations=MAX_ITERATIONS,
    )
    if solution is None or not np.all(np.isfinite(solution)):
        return None
    return solution[: s * b].reshape(s, b), solution[s * b :]
