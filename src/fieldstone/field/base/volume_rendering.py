"""Emission and absorption along rays: density and colour samples to weights, colour, depth and opacity.

With density sigma_i and colour c_i on the interval from t_i to t_(i+1), of length delta_i,

    tau_i = sigma_i delta_i                     optical depth of interval i
    T_i   = exp(-sum_{j<i} tau_j)               light that reaches it
    w_i   = T_i (1 - exp(-tau_i))               share of the pixel's light that ends in it
    C     = sum_i w_i c_i + (1 - sum_i w_i) C_background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Composite:
    """What comes out of the rays; see the module for the symbols.

    opacity: sum_i w_i. depth: expected distance at which the light ends, sum_i w_i t_i + (1 - opacity) far.
    """

    rgb: Float[np.ndarray, "r 3"]
    depth: Float[np.ndarray, "r"]
    opacity: Float[np.ndarray, "r"]
    weights: Float[np.ndarray, "r s"]


def interval_lengths(t: Float[np.ndarray, "r s"], far: float) -> Float[np.ndarray, "r s"]:
    """delta_i = t_(i+1) - t_i; the last interval ends at `far`.

    Source:
        `mildenhall2020`, eq. 3. Departure: its released program gives the last interval no end, which makes the
        faintest density in the last sample opaque.
    """
    return np.diff(t, axis=1, append=np.full_like(t[:, :1], far))


def ray_weights(tau: Float[np.ndarray, "r s"]) -> Float[np.ndarray, "r s"]:
    """w_i = exp(-sum_{j<i} tau_j) (1 - exp(-tau_i)), exact for small tau too.

    Source:
        `max1995`, section 3; `mildenhall2020`, eq. 3.
    """
    return np.exp(-(np.cumsum(tau, axis=1) - tau)) * -np.expm1(-tau)


def composite(
    density: Float[np.ndarray, "r s"],
    color: Float[np.ndarray, "r s 3"],
    t: Float[np.ndarray, "r s"],
    *,
    far: float,
    background: Float[np.ndarray, "3"],
) -> Composite:
    """Colour, depth, opacity and weights of rays from samples at increasing distances t < far.

    Args:
        density: sigma, not negative, in 1 / (unit of t).
    """
    weights = ray_weights(density * interval_lengths(t, far))
    opacity = weights.sum(axis=1)
    rgb = np.einsum("rs,rsc->rc", weights, color) + (1.0 - opacity)[:, None] * background
    depth = np.einsum("rs,rs->r", weights, t) + (1.0 - opacity) * far
    return Composite(rgb, depth, opacity, weights)
