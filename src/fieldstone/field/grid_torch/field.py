"""The grid field in torch: the same parameters, with gradients by autograd.

`TorchGridField` is the oracle for the hand-written gradients; what follows the interpolation also trains the field on
other devices than the CPU, see `grid_torch.training`. Samples are packed: sample i belongs to ray `ray[i]`, and the
samples of a ray lie in order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fieldstone.field.grid.decoder import DIRECTIONS, HIDDEN, Decoder
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.layout import CHANNELS
from fieldstone.field.grid.march_numba import MAX_LOG_DENSITY


@dataclass(frozen=True, eq=False)
class TorchGridField:
    """Parameters of a grid field as leaf tensors, and what does not learn."""

    levels: tuple[Tensor, ...]
    """(x, y, z, 4) each."""
    spacings: tuple[float, ...]
    decoder: dict[str, Tensor]
    """By the names of `Decoder`."""
    density_bias: float


def torch_grid_field(field: GridField, dtype: torch.dtype, device: torch.device) -> TorchGridField:
    """The parameters of a field, copied; gradients are required."""

    def leaf(array: object) -> Tensor:
        return torch.tensor(array, dtype=dtype, device=device, requires_grad=True)

    levels = tuple(leaf(field.layout.level(field.table, n)) for n in range(field.layout.num_levels))
    decoder = {name: leaf(getattr(field.decoder, name)) for name in Decoder._fields}
    return TorchGridField(levels, tuple(field.layout.spacings.tolist()), decoder, field.density_bias)


def interpolate(field: TorchGridField, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n l c"]:
    """As `layout.interpolate`."""
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
    decoder: dict[str, Tensor], values: Float[Tensor, "n l c"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """As `decoder.decode`."""
    x, y, z = directions.unbind(dim=1)
    basis = torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0], dim=1)
    weights = decoder["feature_weights"].reshape(-1, CHANNELS, HIDDEN)[: values.shape[1], 1:]
    hidden = torch.einsum("nlc,lch->nh", values[:, :, 1:], weights)
    hidden = hidden + basis @ decoder["direction_weights"].reshape(DIRECTIONS, HIDDEN) + decoder["hidden_bias"]
    return torch.sigmoid(hidden.relu() @ decoder["color_weights"].reshape(3, HIDDEN).T + decoder["color_bias"])


def optical_depths_of(values: Float[Tensor, "n l c"], density_bias: float, depth_scale: float) -> Float[Tensor, "n"]:
    """Optical depth of each sample from its interpolated values.

    Above `MAX_LOG_DENSITY` a sample is as dense as it gets; its gradient is that of what it has, not 0: it can get
    thinner.

    Args:
        depth_scale: Optical depth of a sample at density 1.
    """
    log_density = values[:, :, 0].sum(dim=1) + density_bias
    log_density = log_density - (log_density - float(MAX_LOG_DENSITY)).clamp(min=0.0).detach()
    return torch.exp(log_density) * depth_scale


def depths_before(
    tau: Float[Tensor, "n"], ray: Int[Tensor, "n"], num_rays: int
) -> tuple[Float[Tensor, "n"], Float[Tensor, "r"]]:
    """Optical depth in front of each packed sample, and of whole rays.

    Sums run along each ray on its own: one over all samples would lose the small ones in float32.
    """
    count = torch.zeros(num_rays, dtype=ray.dtype, device=ray.device).index_add(0, ray, torch.ones_like(ray))
    first = torch.cumsum(count, dim=0) - count
    place = torch.arange(len(ray), device=ray.device) - first[ray]
    most = int(count.max()) if num_rays else 0
    # (r, s + 1): a zero leads, so that the sum up to a sample does not hold the sample itself.
    by_ray = tau.new_zeros((num_rays, most + 1)).index_put((ray, place + 1), tau)
    sums = torch.cumsum(by_ray, dim=1)
    return sums[ray, place], sums[:, most]


def composite_packed(
    rgb: Float[Tensor, "n 3"],
    weights: Float[Tensor, "n"],
    ray: Int[Tensor, "n"],
    end_transmittance: Float[Tensor, "r"],
    background: Float[Tensor, "r 3"],
) -> Float[Tensor, "r 3"]:
    """Colours of rays from those of their samples, and of the background where light passes."""
    return (end_transmittance[:, None] * background).index_add(0, ray, weights[:, None] * rgb)


def packed_colors(
    field: TorchGridField,
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
    values = interpolate(field, points)
    tau = optical_depths_of(values, field.density_bias, depth_scale)
    before, total = depths_before(tau, ray, len(directions))
    weights = torch.exp(-before) * -torch.expm1(-tau)
    rgb = decode(field.decoder, values, directions[ray])
    return composite_packed(rgb, weights, ray, torch.exp(-total), background)


def optical_depths(field: TorchGridField, points: Float[Tensor, "n 3"], depth_scale: float) -> Float[Tensor, "n"]:
    """Optical depth of each sample; arguments as of `packed_colors`."""
    return optical_depths_of(interpolate(field, points), field.density_bias, depth_scale)


def packed_weights(
    field: TorchGridField, points: Float[Tensor, "n 3"], ray: Int[Tensor, "n"], num_rays: int, depth_scale: float
) -> Float[Tensor, "n"]:
    """Share of the light of its ray that ends in each packed sample; arguments as of `packed_colors`."""
    tau = optical_depths(field, points, depth_scale)
    before, _ = depths_before(tau, ray, num_rays)
    return torch.exp(-before) * -torch.expm1(-tau)
