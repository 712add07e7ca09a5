"""Robust losses on squared residual lengths, as (rho, weight) pairs.

The cost of residual r is 0.5 rho(|r|^2); `weight` is rho'(|r|^2), the factor by which iteratively reweighted least
squares multiplies |r|^2. Every loss equals |r|^2 near 0 and has its bend at |r| = scale.

Source:
    `triggs2000`, section 4.3 and appendix; `hartley2004`, appendix 6.8.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

RobustLoss = Callable[[Float[np.ndarray, "*o"]], tuple[Float[np.ndarray, "*o"], Float[np.ndarray, "*o"]]]


def trivial() -> RobustLoss:
    """Plain least squares: rho(s) = s."""
    return lambda s: (s, np.ones_like(s))


def huber(scale: float) -> RobustLoss:
    """Quadratic up to |r| = scale, linear beyond."""
    c2 = _squared(scale)

    def loss(s):
        root = np.sqrt(np.maximum(s, c2) / c2)
        return np.where(s <= c2, s, c2 * (2.0 * root - 1.0)), 1.0 / root

    return loss


def soft_l1(scale: float) -> RobustLoss:
    """Smooth Huber: rho(s) = 2 c^2 (sqrt(1 + s/c^2) - 1)."""
    c2 = _squared(scale)

    def loss(s):
        root = np.sqrt(1.0 + s / c2)
        return 2.0 * s / (1.0 + root), 1.0 / root  # equal, without the cancellation at small s

    return loss


def cauchy(scale: float) -> RobustLoss:
    """rho(s) = c^2 log(1 + s/c^2): outliers lose almost all weight."""
    c2 = _squared(scale)
    return lambda s: (c2 * np.log1p(s / c2), 1.0 / (1.0 + s / c2))


def robustify(
    loss: RobustLoss, residuals: Float[np.ndarray, "o 2"]
) -> tuple[Float[np.ndarray, "o 2"], Float[np.ndarray, "o 2 2"]]:
    """Residuals f with |f|^2 = rho(|r|^2), and their exact derivative by r.

    A plain least-squares solver that minimises |f|^2 then minimises the robust cost of the 2-vectors r, not of their
    coordinates one by one.
    """
    s = np.sum(residuals**2, axis=1)
    rho, weight = loss(s)
    safe_s = np.where(s > 0, s, 1.0)
    root = np.where(s > 0, np.sqrt(rho / safe_s), 1.0)
    d_root = np.where(s > 0, (weight - rho / safe_s) / (2.0 * safe_s * np.where(root > 0, root, 1.0)), 0.0)
    derivative = root[:, None, None] * np.eye(2)
    derivative = derivative + 2.0 * d_root[:, None, None] * residuals[:, :, None] * residuals[:, None, :]
    return root[:, None] * residuals, derivative


def _squared(scale: float) -> float:
    if not scale > 0:
        raise ValueError(f"the scale of a robust loss must be positive, got {scale}")
    return scale * scale
