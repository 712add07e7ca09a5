"""The fast field in torch: the same parameters, with gradients by autograd.

It is the oracle for the hand-written gradients, and runs on any torch device. Samples are packed: sample i belongs to
ray `ray[i]`, and the samples of a ray lie in order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fieldstone.field.fast_decoder import DIRECTIONS, HIDDEN, Decoder
from fieldstone.field.fast_field import FastField
from fieldstone.field.fast_grid import CHANNELS


@dataclass(frozen=True, eq=False)
class TorchFastField:
    """Parameters of a fast field as leaf tensors, and what does not learn."""

    levels: tuple[Tensor, ...]
    """(x, y, z, 4) each."""
    spacings: tuple[float, ...]
    decoder: dict[str, Tensor]
    """By the names of `Decoder`."""
    raw_offset: float


def torch_fast_field(field: FastField, dtype: torch.dtype, device: torch.device) -> TorchFastField:
    """The parameters of a field, copied; gradients are required."""

    def leaf(array: object) -> Tensor:
        return torch.tensor(array, dtype=dtype, device=device, requires_grad=True)

    levels = tuple(leaf(field.layout.level(field.table, n)) for n in range(field.layout.num_levels))
    decoder = {name: leaf(getattr(field.decoder, name)) for name in Decoder._fields}
    return TorchFastField(levels, tuple(field.layout.spacings.tolist()), decoder, field.raw_offset)


def interpolate(field: TorchFastField, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n l c"]:
    """As `fast_grid.interpolate`."""
    out = []
    for vertices, spacing in zip(field.levels, field.spacings, strict=True):
        x = points / spacing
        cell = torch.floor(x).long()
        f = x - cell
        value = torch.zeros((len(points), CHANNELS), dtype=points.dtype, device=points.device)
        for corner in torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3):
            weight = torch.where(corner == 1, f, 1.0 - f).prod(dim=1)
            i, j, k = (cell + corner).unbind(dim=1)
            value = value + weight[:, None] * vertices[i, j, k]
        out.append(value)
    return torch.stack(out, dim=1)


def decode(
    field: TorchFastField, values: Float[Tensor, "n l c"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """As `fast_decoder.decode`."""
    decoder = field.decoder
    x, y, z = directions.unbind(dim=1)
    basis = torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0], dim=1)
    weights = decoder["feature_weights"].reshape(-1, CHANNELS, HIDDEN)[: values.shape[1], 1:]
    hidden = torch.einsum("nlc,lch->nh", values[:, :, 1:], weights)
    hidden = hidden + basis @ decoder["direction_weights"].reshape(DIRECTIONS, HIDDEN) + decoder["hidden_bias"]
    return torch.sigmoid(hidden.relu() @ decoder["color_weights"].reshape(3, HIDDEN).T + decoder["color_bias"])


def packed_colors(
    field: TorchFastField,
    points: Float[Tensor, "n 3"],
    ray: Int[Tensor, "n"],
    directions: Float[Tensor, "r 3"],
    background: Float[Tensor, "r 3"],
    depth_scale: float,
) -> Float[Tensor, "r 3"]:
    """Colours of rays from packed samples, of which each stands for the same optical path.

    Args:
        depth_scale: Optical depth of a sample at density 1.
    """
    weights = packed_weights(field, points, ray, len(directions), depth_scale)
    colors = decode(field, interpolate(field, points), directions[ray])
    out = torch.zeros_like(background).index_add(0, ray, weights[:, None] * colors)
    opacity = torch.zeros_like(background[:, 0]).index_add(0, ray, weights)
    return out + (1.0 - opacity)[:, None] * background


def optical_depths(field: TorchFastField, points: Float[Tensor, "n 3"], depth_scale: float) -> Float[Tensor, "n"]:
    """Optical depth of each sample; arguments as of `packed_colors`."""
    return torch.exp(interpolate(field, points)[:, :, 0].sum(dim=1) + field.raw_offset) * depth_scale


def packed_weights(
    field: TorchFastField, points: Float[Tensor, "n 3"], ray: Int[Tensor, "n"], num_rays: int, depth_scale: float
) -> Float[Tensor, "n"]:
    """Share of the light of its ray that ends in each packed sample; arguments as of `packed_colors`."""
    tau = optical_depths(field, points, depth_scale)
    before = torch.cumsum(tau, dim=0) - tau
    # The sum before the first sample of each ray is taken off, so that every ray starts anew.
    starts = torch.searchsorted(ray, torch.arange(num_rays, device=ray.device, dtype=ray.dtype))
    offset = torch.where(starts < len(ray), before[starts.clamp(max=len(ray) - 1)], before.new_zeros(()))
    return torch.exp(offset[ray] - before) * -torch.expm1(-tau)
