"""The damped step of poses and cameras: the reduced system is factored, or where that is too dear, solved in steps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.solve.algebra.tile_cholesky_numba import (
    cholesky_in_place_numba,
    factor_column_numba,
    factor_diagonal_numba,
    factor_numba,
    solve_transposed_numba,
)
from fieldstone.solve.bundle.layout import BundleLayout
from fieldstone.solve.bundle.schur_pcg import TOLERANCE, solve_iteratively
from fieldstone.solve.bundle.schur_solver import (
    CameraSystem,
    Linearization,
    ReducedSystem,
    Step,
    TilePattern,
    Values,
    Workers,
    Workspace,
    reduce_system,
)


def solve_step(
    layout: BundleLayout, pattern: TilePattern, values: Values, pivot: Float[np.ndarray, "3"], at: Linearization,
    system: CameraSystem, damping: float, work: Workspace, workers: Workers, *, pcg_tolerance: float = TOLERANCE,
) -> Step | None:  # fmt: skip
    """The damped step of poses and cameras; None where the reduced system is not positive definite."""
    reduced = reduce_system(layout, pattern, values, pivot, at, system, damping, work, workers)
    if pattern.direct:
        solution = _solve_reduced(pattern, reduced, work, workers)
    else:
        solution = solve_iteratively(
            layout, pattern, values, pivot, system, reduced, damping, work, workers, tolerance=pcg_tolerance
        )
    if solution is None:
        return None
    dx, dx_border = solution
    # Holds for the exact solution and for every iterate of conjugate gradients: d (H + damping diag H) d = -g d.
    promised = np.sum((damping * np.einsum("saa->sa", system.U) * dx - system.g) * dx)
    promised += np.sum((damping * np.diag(system.corner) * dx_border - system.g_border) * dx_border)
    return Step(dx, dx_border, 0.5 * float(promised))


def _solve_reduced(
    pattern: TilePattern, reduced: ReducedSystem, work: Workspace, workers: Workers
) -> tuple[Float[np.ndarray, "s b"], Float[np.ndarray, "n"]] | None:
    """Solve [[S, border^T], [border, corner]] [dx; dx_border] = [rhs; rhs_border] by block elimination."""
    border, rhs, corner, rhs_border = reduced.border, reduced.rhs, reduced.corner, reduced.rhs_border
    n, (s, b) = len(border), rhs.shape
    count, size = len(pattern.index), pattern.per_tile * b
    wide = np.zeros((n + 1, count * size))
    wide[:n, : s * b] = border.reshape(n, s * b)
    wide[n, : s * b] = rhs.ravel()
    wide = np.ascontiguousarray(wide.reshape(n + 1, count, size).swapaxes(0, 1))
    if not _factor(pattern, wide, s, work, workers):
        return None
    flat = wide.swapaxes(0, 1).reshape(n + 1, count * size)
    dx_border = np.zeros(n)
    if n:
        corner = corner - flat[:n] @ flat[:n].T
        if not cholesky_in_place_numba(corner):
            return None
        dx_border = _solve_lower(corner, rhs_border - flat[:n] @ flat[n])
    x = np.ascontiguousarray((flat[n] - dx_border @ flat[:n]).reshape(count, size))
    solve_transposed_numba(pattern.index, work.L, work.diagonal_inverse, x)
    dx = x.ravel()[: s * b].reshape(s, b)
    if not (np.all(np.isfinite(dx)) and np.all(np.isfinite(dx_border))):
        return None
    return dx, dx_border


def _factor(
    pattern: TilePattern, wide: Float[np.ndarray, "t r n"], num_slots: int, work: Workspace, workers: Workers
) -> bool:
    """Tile Cholesky of the reduced system; `wide` becomes the rows below it."""
    args = (work.tiles, pattern.index, work.L, work.diagonal_inverse, num_slots)
    if workers.threads == 1 or len(pattern.index) < 8:
        return factor_numba(*args, wide)
    for J in range(len(pattern.index)):
        if not factor_diagonal_numba(J, *args):
            return False
        bounds = [(J, k, workers.threads) for k in range(workers.threads)]
        workers.over(factor_column_numba, bounds, *args, wide)
    return True


def _solve_lower(L: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """x with L L^T x = b."""
    x = np.linalg.solve(L, b)
    return np.linalg.solve(L.T, x)
