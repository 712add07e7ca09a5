"""Where along a ray a field is asked: stratified samples, and more where the first ones found something."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

PDF_FLOOR = 1e-5
"""Added to every weight before it is normalised, so that rays through nothing still have a distribution."""


def stratified(near: float, far: float, noise: Float[np.ndarray, "r s"]) -> Float[np.ndarray, "r s"]:
    """One distance in each of s equal bins of [near, far]: t_i = near + (i + u_i) (far - near) / s.

    Args:
        noise: u in [0, 1), where in its bin each sample lies; 0.5 everywhere gives the midpoints.

    Source:
        `mildenhall2020`, eq. 2.
    """
    num_samples = noise.shape[1]
    return near + (np.arange(num_samples) + noise) * ((far - near) / num_samples)


def inverse_cdf(
    edges: Float[np.ndarray, "r s_plus_1"], weights: Float[np.ndarray, "r s"], u: Float[np.ndarray, "r m"]
) -> Float[np.ndarray, "r m"]:
    """Distances at which the cumulated weight reaches the share u: samples of a density constant between the edges.

    Args:
        edges: Increasing along each ray.
        weights: Not negative; interval i, from edges[i] to edges[i + 1], has probability proportional to weights[i]
            (plus a floor of 1e-5).
        u: Shares in [0, 1).

    Source:
        `mildenhall2020`, section 5.2. Departure: the intervals are those that the weights were computed for, not
        those between the midpoints of the samples.
    """
    probability = weights + PDF_FLOOR
    cumulated = np.cumsum(probability, axis=1)
    cdf = np.concatenate([np.zeros_like(cumulated[:, :1]), cumulated / cumulated[:, -1:]], axis=1)
    # Interval i with cdf[i] <= u < cdf[i + 1].
    interval = np.sum(u[:, :, None] >= cdf[:, None, 1:-1], axis=2)
    cdf_below = np.take_along_axis(cdf, interval, axis=1)
    cdf_above = np.take_along_axis(cdf, interval + 1, axis=1)
    edge_below = np.take_along_axis(edges, interval, axis=1)
    edge_above = np.take_along_axis(edges, interval + 1, axis=1)
    return edge_below + (u - cdf_below) / (cdf_above - cdf_below) * (edge_above - edge_below)


def hierarchical(
    t: Float[np.ndarray, "r s"], weights: Float[np.ndarray, "r s"], far: float, noise: Float[np.ndarray, "r m"]
) -> Float[np.ndarray, "r s_plus_m"]:
    """The coarse distances t together with m new ones drawn where their weights are, sorted.

    Args:
        weights: Of the intervals from t_i to t_(i+1), the last one ending at `far`.
        noise: In [0, 1); new sample j is drawn at the share (j + noise_j) / m of the weight (stratified).

    Source:
        `mildenhall2020`, section 5.2, eq. 5.
    """
    edges = np.concatenate([t, np.full_like(t[:, :1], far)], axis=1)
    num_new = noise.shape[1]
    shares = (np.arange(num_new) + noise) / num_new
    return np.sort(np.concatenate([t, inverse_cdf(edges, weights, shares)], axis=1), axis=1)
