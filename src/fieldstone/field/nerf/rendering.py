"""Encodings, sampling and volume rendering in torch: the same mathematics as the modules without torch.

`encodings`, `sampling` and `volume_rendering` are the reference; names and shapes are theirs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fieldstone.field.nerf.sampling import PDF_FLOOR


@dataclass(frozen=True, eq=False)
class Composite:
    """As `volume_rendering.Composite`."""

    rgb: Float[Tensor, "r 3"]
    depth: Float[Tensor, "r"]
    opacity: Float[Tensor, "r"]
    weights: Float[Tensor, "r s"]


def frequency_encoding(x: Float[Tensor, "*n 3"], num_frequencies: int) -> Float[Tensor, "*n k"]:
    """As `encodings.frequency_encoding`."""
    frequencies = 2.0 ** torch.arange(num_frequencies, dtype=x.dtype, device=x.device)
    angles = (x[..., None, :] * frequencies[:, None]).flatten(-2)  # (*n, 3 L)
    return torch.cat([x, torch.sin(angles), torch.cos(angles)], dim=-1)


def stratified(near: float, far: float, noise: Float[Tensor, "r s"]) -> Float[Tensor, "r s"]:
    """As `sampling.stratified`."""
    num_samples = noise.shape[1]
    bins = torch.arange(num_samples, dtype=noise.dtype, device=noise.device)
    return near + (bins + noise) * ((far - near) / num_samples)


def inverse_cdf(
    edges: Float[Tensor, "r s_plus_1"], weights: Float[Tensor, "r s"], u: Float[Tensor, "r m"]
) -> Float[Tensor, "r m"]:
    """As `sampling.inverse_cdf`."""
    cumulated = torch.cumsum(weights + PDF_FLOOR, dim=1)
    cdf = torch.cat([torch.zeros_like(cumulated[:, :1]), cumulated / cumulated[:, -1:]], dim=1)
    interval = torch.searchsorted(cdf[:, 1:-1].contiguous(), u.contiguous(), right=True)
    cdf_below, cdf_above = cdf.gather(1, interval), cdf.gather(1, interval + 1)
    edge_below, edge_above = edges.gather(1, interval), edges.gather(1, interval + 1)
    return edge_below + (u - cdf_below) / (cdf_above - cdf_below) * (edge_above - edge_below)


def hierarchical(
    t: Float[Tensor, "r s"], weights: Float[Tensor, "r s"], far: float, noise: Float[Tensor, "r m"]
) -> Float[Tensor, "r s_plus_m"]:
    """As `sampling.hierarchical`. No gradient flows through where samples lie."""
    with torch.no_grad():
        edges = torch.cat([t, torch.full_like(t[:, :1], far)], dim=1)
        num_new = noise.shape[1]
        shares = (torch.arange(num_new, dtype=t.dtype, device=t.device) + noise) / num_new
        return torch.sort(torch.cat([t, inverse_cdf(edges, weights, shares)], dim=1), dim=1).values


def composite(
    density: Float[Tensor, "r s"],
    color: Float[Tensor, "r s 3"],
    t: Float[Tensor, "r s"],
    *,
    far: float,
    background: Float[Tensor, "3"],
) -> Composite:
    """As `volume_rendering.composite`."""
    tau = density * torch.diff(t, dim=1, append=torch.full_like(t[:, :1], far))
    weights = torch.exp(tau - torch.cumsum(tau, dim=1)) * -torch.expm1(-tau)
    opacity = weights.sum(dim=1)
    rgb = (weights[..., None] * color).sum(dim=1) + (1.0 - opacity)[:, None] * background
    depth = (weights * t).sum(dim=1) + (1.0 - opacity) * far
    return Composite(rgb, depth, opacity, weights)
