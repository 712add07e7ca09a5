"""Adam in torch, as a pure function; `field.base.adam` is the reference."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-7


def adam(
    parameters: Float[Tensor, "p"],
    first_moment: Float[Tensor, "p"],
    second_moment: Float[Tensor, "p"],
    gradient: Float[Tensor, "p"],
    *,
    step: int,
    learning_rate: float,
) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"], Float[Tensor, "p"]]:
    """Parameters and moments after one step of Adam; `step` counts from 1.

    Source:
        `kingma2015`, algorithm 1; beta1 0.9, beta2 0.999, epsilon 1e-7 as in `mildenhall2020`.
    """
    first = BETA1 * first_moment + (1 - BETA1) * gradient
    second = BETA2 * second_moment + (1 - BETA2) * gradient**2
    denominator = torch.sqrt(second / (1 - BETA2**step)) + EPSILON
    return parameters - (learning_rate / (1 - BETA1**step)) * first / denominator, first, second
