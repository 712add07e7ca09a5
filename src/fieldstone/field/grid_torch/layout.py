"""The feature grids of the grid field on a torch device: interpolated from, and moved, only where samples lie.

All levels are rows of one table. A batch takes the rows that it touches out of the table; they alone are leaves of
autograd and are put back after their step, so that a step costs what its samples cost, not what the grid holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fieldstone.field.grid.layout import CHANNELS, GridLayout


@dataclass(frozen=True, eq=False)
class TorchGrid:
    """Vertices of all levels, one row each, in the order of `GridField.table`; updated in place by `step_rows`."""

    vertices: Float[Tensor, "m c"]
    mean_square: Float[Tensor, "m c"]
    """Mean squared gradient of each value."""
    first: Int[Tensor, "l"]
    """Row of the first vertex of each level."""
    sizes: Int[Tensor, "l 3"]
    per_unit: Float[Tensor, "l"]
    """Vertices per unit of length."""


def torch_grid(
    layout: GridLayout, table: Float[np.ndarray, "t"], mean_square: Float[np.ndarray, "t"], device: torch.device
) -> TorchGrid:
    """A grid and its mean squared gradients, copied to a device."""

    def copied(array: np.ndarray) -> Tensor:
        return torch.tensor(array, device=device)

    return TorchGrid(
        copied(table.reshape(-1, CHANNELS)),
        copied(mean_square.reshape(-1, CHANNELS)),
        copied(layout.offsets[:-1] // CHANNELS),
        copied(layout.sizes),
        copied((1.0 / layout.spacings).astype(np.float32)),
    )


def corners_of(grid: TorchGrid, points: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n l 8"], Float[Tensor, "n l 8"]]:
    """Rows of the vertices around points on every level, and their trilinear weights.

    Args:
        points: Inside the box, relative to its lower corner.
    """
    x = points[:, None] * grid.per_unit[:, None]  # (n, l, 3)
    cell = torch.floor(x)
    f = (x - cell)[:, :, None]
    corners = torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3)
    weights = torch.where(corners == 1, f, 1.0 - f).prod(dim=3)
    i, j, k = (cell.long()[:, :, None] + corners).unbind(dim=3)  # (n, l, 8)
    rows = (i * grid.sizes[:, 1, None] + j) * grid.sizes[:, 2, None] + k
    return grid.first[:, None] + rows, weights


def weighted_rows(
    vertices: Float[Tensor, "k c"], rows: Int[Tensor, "n l 8"], weights: Float[Tensor, "n l 8"]
) -> Float[Tensor, "n l c"]:
    """As `layout.interpolate`, with what `corners_of` found."""
    values = vertices.index_select(0, rows.reshape(-1)).reshape(*rows.shape, vertices.shape[1])
    return (weights[..., None] * values).sum(dim=2)


def step_rows(
    grid: TorchGrid,
    rows: Int[Tensor, "k"],
    gradient: Float[Tensor, "k c"],
    rates: Float[Tensor, "c"],
    decay_factors: Float[Tensor, "l c"],
    decay: float,
    epsilon: float,
) -> None:
    """One step of `interpolation_numba.step_touched`, in place.

    Args:
        rows: Each once.
        decay_factors: What weight decay leaves of each level, by channel.
    """
    vertices, mean_square = grid.vertices[rows], grid.mean_square[rows]
    v = decay * mean_square + (1.0 - decay) * gradient**2
    level = torch.searchsorted(grid.first, rows, right=True) - 1
    stepped = decay_factors[level] * vertices - rates * gradient / (torch.sqrt(v) + epsilon)
    touched = gradient != 0
    grid.mean_square[rows] = torch.where(touched, v, mean_square)
    grid.vertices[rows] = torch.where(touched, stepped, vertices)
