"""Adam, for arrays that are updated in place."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def adam_estimates(
    first_moment: Float[np.ndarray, "*n"],
    second_moment: Float[np.ndarray, "*n"],
    gradient: Float[np.ndarray, "*n"],
    step: int,
    *,
    betas: tuple[float, float],
    epsilon: float,
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Update both moments in place, and return what a step is made of: rate * numerator / denominator.

    m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2;  numerator m / (1 - b1^t),  denominator sqrt(v / (1 - b2^t)) + e.

    Args:
        first_moment, second_moment: m and v, float32 as the gradient.
        step: t, from 1.

    Source:
        `kingma2015`, algorithm 1.
    """
    beta1, beta2 = (np.float32(beta) for beta in betas)
    correction1, correction2 = (np.float32(1.0 - beta**step) for beta in betas)
    first_moment[...] = beta1 * first_moment + (1 - beta1) * gradient
    second_moment[...] = beta2 * second_moment + (1 - beta2) * gradient * gradient
    return first_moment / correction1, np.sqrt(second_moment / correction2) + np.float32(epsilon)
