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
from fieldstone.solve.bundle.layout import BundleLayout
from fieldstone.solve.bundle.schur_pcg_numba import points_of_views_numba, views_of_points_numba
from fieldstone.solve.bundle.schur_solver import CameraSystem, ReducedSystem, TilePattern, Values, Workers, Workspace

TOLERANCE = 0.1
"""How far the residual falls for one step; a better solution hardly makes a better step."""
MAX_ITERATIONS = 500


def solve_iteratively(
    layout: BundleLayout, pattern: TilePattern, values: Values, pivot: Float[np.ndarray, "3"], system: CameraSystem,
    reduced: ReducedSystem, damping: float, work: Workspace, workers: Workers, *, tolerance: float,
) -> tuple[Float[np.ndarray, "s b"], Float[np.ndarray, "n"]] | None:  # fmt: skip
    """Steps of the views and of the border; None where the system is not positive definite.

    Args:
        reduced: The border of the reduced system, and in `work.tiles` its diagonal blocks.
    """
    border, rhs, n = reduced.border, reduced.rhs, len(reduced.border)
    s, b = rhs.shape
    count, size = len(pattern.index), pattern.per_tile * b
    if not factor_numba(work.tiles, pattern.index, work.L, work.diagonal_inverse, s, np.empty((count, 0, size))):
        return None
    corner = np.tril(reduced.corner) + np.tril(reduced.corner, -1).T
    try:
        corner_inverse = np.linalg.inv(np.linalg.cholesky(corner)) if n else corner
    except np.linalg.LinAlgError:
        return None
    w = np.empty((len(layout.free_point), 3))

    def apply(x: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        views, out = x[: s * b].reshape(s, b), np.empty((s, b))
        workers.over(
            points_of_views_numba, workers.split(layout.point_start),
            layout.slot, layout.point_start, values.points, pivot, work.Z, views, w,
        )  # fmt: skip
        workers.over(
            views_of_points_numba, workers.split(layout.list_start[: s + 1]),
            layout.list_start, layout.list_obs, layout.point, layout.free_point, values.points, pivot, work.Z,
            system.U, damping, views, w, out,
        )  # fmt: skip
        out += np.einsum("nsb,n->sb", border, x[s * b :])
        return np.concatenate([out.ravel(), np.einsum("nsb,sb->n", border, views) + corner @ x[s * b :]])

    def precondition(r: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        tiles = np.zeros((count, size))
        tiles.ravel()[: s * b] = r[: s * b]
        half = np.einsum("tij,tj->ti", work.diagonal_inverse, tiles)
        whole = np.einsum("tij,ti->tj", work.diagonal_inverse, half)
        return np.concatenate([whole.ravel()[: s * b], corner_inverse.T @ (corner_inverse @ r[s * b :])])

    solution = conjugate_gradients(
        apply,
        np.concatenate([rhs.ravel(), reduced.rhs_border]),
        precondition,
        tolerance=tolerance,
        max_iterations=MAX_ITERATIONS,
    )
    if solution is None or not np.all(np.isfinite(solution)):
        return None
    return solution[: s * b].reshape(s, b), solution[s * b :]
