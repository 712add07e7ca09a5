"""Rays through a grid field on a torch device: the samples of `march_numba.march_rays`, all rays at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fieldstone.field.base.space import Space
from fieldstone.field.grid.field import FOREVER
from fieldstone.field.grid.march_numba import MIN_LOG_DENSITY, March
from fieldstone.field.grid.occupancy import Occupancy
from fieldstone.field.grid_torch.field import depths_before, optical_depths_of
from fieldstone.field.grid_torch.layout import TorchGrid, corners_of, weighted_rows

POSITIONS_AT_ONCE = 1 << 22
"""Places on rays that are looked at together: about 300 MB."""

LOOK_EVERY = 32
"""Steps of a march to infinity between asking whether all rays have ended: asking waits for the device."""


@dataclass(frozen=True, eq=False)
class TorchBox:
    """Where there is something, as `march_numba.Box`, without the distances."""

    lower: Float[Tensor, "3"]
    extent: Float[Tensor, "3"]
    cells: Bool[Tensor, "x y z"]
    cell_size: float
    space: Space


@dataclass(frozen=True, eq=False)
class PackedSamples:
    """What weighs along the first `num_rays` rays of a batch, ray by ray."""

    num_rays: int
    points: Float[Tensor, "n 3"]
    """In the grid, relative to the lower corner of the box."""
    distance: Float[Tensor, "n"]
    ray: Int[Tensor, "n"]
    skipped_tau: Float[Tensor, "n"]
    """Optical depth in front of each sample that was left out because it hardly weighs."""
    skipped_tau_of_ray: Float[Tensor, "r"]
    """The same for whole rays."""


def torch_box(occupancy: Occupancy, extent: Float[np.ndarray, "3"], space: Space, device: torch.device) -> TorchBox:
    """As `field.occupancy_box`, on a device."""
    lower, size = (torch.tensor(a.astype(np.float32), device=device) for a in (occupancy.lower, extent))
    cells = torch.tensor(occupancy.cells, device=device)
    return TorchBox(lower, size, cells, float(occupancy.cell_size), space)


def march_packed(
    grid: TorchGrid,
    box: TorchBox,
    march: March,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    jitter: Float[Tensor, "r"],
    capacity: int,
) -> PackedSamples:
    """The samples of as many rays, from the first on, as have less than `capacity` together (of one ray at least).

    Args:
        jitter: Share of a step before the first sample.
    """
    with torch.no_grad():
        points, distance, ray = _occupied_positions(box, march, origins, directions, jitter)
        values = weighted_rows(grid.vertices, *corners_of(grid, points))
        tau = optical_depths_of(values, float(march.density_bias), float(march.depth_scale))
        empty = values[:, :, 0].sum(dim=1) + float(march.density_bias) <= float(MIN_LOG_DENSITY)
        tau = torch.where(empty, 0.0, tau)
        transmittance = torch.exp(-depths_before(tau, ray, len(origins))[0])
        reached = transmittance >= float(march.early_stop_eps)
        kept = reached & (transmittance * -torch.expm1(-tau) > float(march.min_weight))
        counts = torch.zeros(len(origins), dtype=ray.dtype, device=ray.device).index_add(0, ray, kept.to(ray.dtype))
        num_rays = max(int(torch.count_nonzero(torch.cumsum(counts, dim=0) < capacity)), 1)
        within = ray < num_rays
        thin = torch.where(reached & ~kept, tau, 0.0)[within]
        skipped_tau, skipped_tau_of_ray = depths_before(thin, ray[within], num_rays)
        kept, of_kept = kept & within, kept[within]
        return PackedSamples(
            num_rays, points[kept], distance[kept], ray[kept], skipped_tau[of_kept], skipped_tau_of_ray
        )


def _occupied_positions(
    box: TorchBox,
    march: March,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    jitter: Float[Tensor, "r"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Int[Tensor, "n"]]:
    """Places in occupied cells, their distances and rays, ray by ray."""
    origins = origins - box.lower
    distances_of = _contracted_distances if box.space.is_contracted else _bounded_distances
    t, end = distances_of(box, march, origins, directions, jitter)
    parts = []
    at_once = max(POSITIONS_AT_ONCE // t.shape[1], 1)
    for first in range(0, len(origins), at_once):
        rows = slice(first, first + at_once)
        points = origins[rows, None] + t[rows, :, None] * directions[rows, None]
        if box.space.is_contracted:
            points = contracted(points, float(box.space.half_side))
        points = torch.minimum(points.clamp(min=0.0), box.extent)
        last = torch.tensor(box.cells.shape, device=points.device) - 1
        i, j, k = torch.minimum((points / box.cell_size).long(), last).unbind(dim=2)
        ray, number = torch.nonzero(box.cells[i, j, k] & (t[rows] < end[rows, None]), as_tuple=True)
        parts.append((points[ray, number], t[rows][ray, number], ray + first))
    points, distance, ray = (torch.cat(column) for column in zip(*parts, strict=True))
    return points, distance, ray


def _bounded_distances(
    box: TorchBox,
    march: March,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    jitter: Float[Tensor, "r"],
) -> tuple[Float[Tensor, "r s"], Float[Tensor, "r"]]:
    """Distances of samples from where a ray enters the box, and where it leaves it."""
    a, b = -origins / directions, (box.extent - origins) / directions
    # A ray along a face divides by 0: it is inside of this pair of faces everywhere or nowhere.
    along = directions.abs() < 1e-9
    inside = (origins >= 0) & (origins <= box.extent)
    nowhere = torch.where(inside, -math.inf, math.inf)
    begin = torch.where(along, nowhere, torch.minimum(a, b)).amax(dim=1).clamp(min=float(march.near))
    end = torch.where(along, -nowhere, torch.maximum(a, b)).amin(dim=1).clamp(max=float(FOREVER))
    meets = begin < end
    begin, end = torch.where(meets, begin, 0.0), torch.where(meets, end, 0.0)
    step = float(march.step)
    count = max(math.ceil(float((end - begin).max()) / step), 1)
    number = torch.arange(count, device=origins.device, dtype=origins.dtype)
    return begin[:, None] + (jitter[:, None] + number) * step, end


def _contracted_distances(
    box: TorchBox,
    march: March,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    jitter: Float[Tensor, "r"],
) -> tuple[Float[Tensor, "r s"], Float[Tensor, "r"]]:
    """Distances of samples to infinity: beyond the inner box, steps grow with the square of the distance."""
    half, step = float(box.space.half_side), float(march.step)
    o, d = origins / half - 2.0, directions / half
    t, out = float(march.near) + jitter * step, []
    while len(out) % LOOK_EVERY or bool((t < float(FOREVER)).any()):
        out.append(t)
        m = (o + t[:, None] * d).abs().amax(dim=1).clamp(min=1.0)
        t = (t + step * m * m).clamp(max=float(FOREVER))
    return torch.stack(out, dim=1), torch.full_like(t, float(FOREVER))


def contracted(points: Float[Tensor, "r s 3"], half_side: float) -> Float[Tensor, "r s 3"]:
    """`space_numba.contract_numba`."""
    c = points / half_side - 2.0
    reach = c.abs().amax(dim=2, keepdim=True).clamp(min=1.0)
    return (2.0 + c * (2.0 - 1.0 / reach) / reach) * half_side
