"""Linear systems too large to factor: preconditioned conjugate gradients, stopped early."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Apply = Callable[[Float[np.ndarray, "n"]], Float[np.ndarray, "n"]]


def conjugate_gradients(
    apply: Apply,
    rhs: Float[np.ndarray, "n"],
    precondition: Apply,
    *,
    tolerance: float,
    max_iterations: int,
) -> Float[np.ndarray, "n"] | None:
    """An x with A x near `rhs`, from x = 0; None if A or the preconditioner is not positive definite.

    Every iterate is the best one of its Krylov space, so that x . A x = x . rhs wherever it is stopped.

    Args:
        apply: A x, with A symmetric and positive definite.
        precondition: M^-1 r, with M like A.
        tolerance: Stop when the residual, in the norm of M^-1, has fallen by this factor.

    Source:
        `saad2003`, algorithm 9.1.
    """
    x, residual = np.zeros_like(rhs), rhs.copy()
    z = precondition(residual)
    direction, energy = z, _dot(residual, z)
    first = energy
    for _ in range(max_iterations):
        if 0 <= energy <= tolerance**2 * first:
            break
        along = apply(direction)
        curvature = _dot(direction, along)
        if not (curvature > 0 and energy > 0):
            return None
        step = energy / curvature
        x += step * direction
        residual -= step * along
        z = precondition(residual)
        energy, before = _dot(residual, z), energy
        direction = z + (energy / before) * direction
    return x


def _dot(a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> float:
    """The same bits for any number of threads, which a product of BLAS does not promise."""
    return float(np.sum(a * b))
