"""The damped step of poses and intrinsics: the reduced system is factored or, where that is expensive, iterated on."""

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
from fieldstone.solve.bundle.buffers import CameraSystem, Linearization, Step, Values
from fieldstone.solve.bundle.schur_pcg import TOLERANCE, solve_iteratively
from fieldstone.solve.bundle.schur_solver import SchurSolver, reduce_system


def solve_step(
    solver: SchurSolver,
    values: Values,
    at: Linearization,
    system: CameraSystem,
    damping: float,
    *,
    pcg_tolerance: float = TOLERANCE,
) -> Step | None:
    """The damped step of poses and intrinsics; None where the reduced system is not positive definite."""
    reduce_system(solver, values, at, system, damping)
    if solver.pattern.direct:
        solution = _solve_reduced(solver)
    else:
        solution = solve_iteratively(solver, values, system, damping, tolerance=pcg_tolerance)
    if solution is None:
        return None
    dx, dx_shared = solution
    # Holds for the exact solution and for every iterate of conjugate gradients: d (H + damping diag H) d = -g d.
    promised = np.sum((damping * np.einsum("saa->sa", system.U) * dx - system.g) * dx)
    promised += np.sum((damping * np.diag(system.corner) * dx_shared - system.g_shared) * dx_shared)
    return Step(dx, dx_shared, 0.5 * float(promised))


def _solve_reduced(solver: SchurSolver) -> tuple[Float[np.ndarray, "s b"], Float[np.ndarray, "n"]] | None:
    """Solve [[S, border^T], [border, corner]] [dx; dx_shared] = [rhs; rhs_shared] by block elimination."""
    pattern, buffers, (_, border, rhs, corner, rhs_shared) = solver.pattern, solver.buffers, solver.buffers.reduced
    n, (s, b) = len(border), rhs.shape
    count, size = len(pattern.index), pattern.per_tile * b
    wide = np.zeros((n + 1, count * size))
    wide[:n, : s * b] = border.reshape(n, s * b)
    wide[n, : s * b] = rhs.ravel()
    wide = np.ascontiguousarray(wide.reshape(n + 1, count, size).swapaxes(0, 1))
    if not _factor(solver, wide):
        return None
    flat = wide.swapaxes(0, 1).reshape(n + 1, count * size)
    dx_shared = np.zeros(n)
    if n:
        corner = corner - flat[:n] @ flat[:n].T
        if not cholesky_in_place_numba(corner):
            return None
        dx_shared = _solve_lower(corner, rhs_shared - flat[:n] @ flat[n])
    x = np.ascontiguousarray((flat[n] - dx_shared @ flat[:n]).reshape(count, size))
    solve_transposed_numba(pattern.index, buffers.L, buffers.diagonal_inverse, x)
    dx = x.ravel()[: s * b].reshape(s, b)
    if not (np.all(np.isfinite(dx)) and np.all(np.isfinite(dx_shared))):
        return None
    return dx, dx_shared


def _factor(solver: SchurSolver, wide: Float[np.ndarray, "t r n"]) -> bool:
    """Tile Cholesky of the reduced system; `wide` becomes the rows below it."""
    index, workers, buffers = solver.pattern.index, solver.workers, solver.buffers
    args = (buffers.reduced.tiles, index, buffers.L, buffers.diagonal_inverse, solver.layout.num_free_views)
    if workers.threads == 1 or len(index) < 8:
        return factor_numba(*args, wide)
    for J in range(len(index)):
        if not factor_diagonal_numba(J, *args):
            return False
        bounds = [(J, k, workers.threads) for k in range(workers.threads)]
        workers.over(factor_column_numba, bounds, *args, wide)
    return True


def _solve_lower(L: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """x with L L^T x = b."""
    x = np.linalg.solve(L, b)
    return np.linalg.solve(L.T, x)
