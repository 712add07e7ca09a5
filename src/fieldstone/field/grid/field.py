"""The grid field: feature grids, a small decoder and an occupancy, as one value that can be saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.errors import InputError
from fieldstone.field.base.projection import Projection
from fieldstone.field.base.space import Space, box_space, contracted_space, projective_space
from fieldstone.field.grid.decoder import HIDDEN, Decoder, decode
from fieldstone.field.grid.interpolation_numba import interpolate_numba
from fieldstone.field.grid.layout import CHANNELS, GridLayout, grid_layout, interpolate
from fieldstone.field.grid.march_numba import MAX_LOG_DENSITY, MIN_LOG_DENSITY, Box, March
from fieldstone.field.grid.occupancy import Occupancy, cell_distances, in_bricks

REFERENCE_CELLS = 128
"""Density 1 takes the share 1 - 1/e of the light on 1/128 of the longest side of the box."""

FOREVER = np.float32(1e9)


@dataclass(frozen=True, eq=False)
class GridField:
    """What training has found. Lengths are those of the field's frame (normalised)."""

    layout: GridLayout
    table: Float[np.ndarray, "t"]
    decoder: Decoder
    occupancy: Occupancy
    density_bias: float
    step_cells: float
    near: float
    """Distance from the camera at which rays begin."""
    space: Space
    """What the grids live in."""

    @property
    def width(self) -> int:
        """Values per sample."""
        return len(self.decoder.feature_weights) // HIDDEN

    def box(self) -> Box:
        """The occupancy as the kernels take it."""
        return occupancy_box(self.occupancy, self.layout.extent, self.space)

    def march(self, min_weight: float, early_stop_eps: float) -> March:
        """How rays are sampled, with the thresholds of the caller."""
        step = float(self.layout.spacings[-1]) * self.step_cells
        return March(
            step=np.float32(step),
            density_bias=np.float32(self.density_bias),
            depth_scale=np.float32(self.step_depth),
            min_weight=np.float32(min_weight),
            early_stop_eps=np.float32(early_stop_eps),
            near=np.float32(self.near),
        )

    @property
    def step_depth(self) -> float:
        """Optical depth of one step at density 1."""
        return float(self.layout.spacings[-1]) * self.step_cells / self.reference_length

    @property
    def reference_length(self) -> float:
        """The length for which `REFERENCE_CELLS` defines the unit of density."""
        return float(np.max(self.layout.extent)) / REFERENCE_CELLS

    def density(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Density at points of a bounded box, per normalised unit of length; 0 outside and in empty cells."""
        local = points - self.occupancy.lower
        cell = np.floor(local / self.occupancy.cell_size).astype(np.int64)
        inside = np.all((local >= 0) & (local < self.layout.extent) & (cell < self.occupancy.cells.shape), axis=1)
        inside[inside] = self.occupancy.cells[tuple(cell[inside].T)]
        grid = self.layout.arrays(self.table)
        values = interpolate_numba(grid, np.ascontiguousarray(local[inside], dtype=np.float32))
        log_density = self.density_bias + values[:, ::CHANNELS].sum(axis=1)
        out = np.zeros(len(points))
        out[inside] = (
            np.where(log_density > MIN_LOG_DENSITY, np.exp(np.minimum(log_density, MAX_LOG_DENSITY)), 0.0)
            / self.reference_length
        )
        return out

    def color(self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Colours in (0, 1) at points inside the box, seen along unit directions."""
        values = interpolate(self.layout, self.table, points - self.occupancy.lower)
        return decode(self.decoder, values.reshape(len(points), -1), directions)

    def to_tensors(self, reachable: Bool[np.ndarray, "v"] | None = None) -> dict[str, np.ndarray]:
        """Everything that rendering needs, as arrays; vertices that no ray can reach are left out.

        Args:
            reachable: `reachable_vertices` of this field, if they are known already.
        """
        projection = self.space.projection
        return {
            "grid": compress(self, self.table, reachable_vertices(self) if reachable is None else reachable),
            "resolutions": np.array(self.layout.resolutions, dtype=np.int64),
            "extent": self.layout.extent,
            "cells": np.packbits(self.occupancy.cells.reshape(-1)),
            "cells_shape": np.array(self.occupancy.cells.shape, dtype=np.int64),
            "cells_box": np.append(self.occupancy.lower, self.occupancy.cell_size),
            "sampling": np.array([self.density_bias, self.step_cells, float(self.space.is_contracted), self.near]),
            "projection": np.array([self.space.is_projective, projection.near, projection.depth], np.float32),
            "projection_R": projection.R,
            "projection_center": projection.center,
            **{f"decoder_{name}": value for name, value in self.decoder._asdict().items()},
        }


def occupancy_box(occupancy: Occupancy, extent: Float[np.ndarray, "3"], space: Space) -> Box:
    """An occupancy as the kernels take it.

    Args:
        extent: Of the grids: the last cells may reach beyond it, samples must not.
    """
    return Box(
        lower=occupancy.lower.astype(np.float32),
        extent=extent.astype(np.float32),
        distance=in_bricks(cell_distances(occupancy.cells)),
        cells=np.array(occupancy.cells.shape, dtype=np.int64),
        cell_size=np.float32(occupancy.cell_size),
        space=space,
    )


def field_from_tensors(tensors: Mapping[str, np.ndarray]) -> GridField:
    """The field of `GridField.to_tensors`.

    Raises:
        InputError: An array is missing or has the wrong shape.
    """
    try:
        lower_and_size = tensors["cells_box"]
        shape = tuple(tensors["cells_shape"].tolist())
        cells = np.unpackbits(tensors["cells"], count=int(np.prod(shape))).astype(bool).reshape(shape)
        occupancy = Occupancy(lower_and_size[:3].copy(), float(lower_and_size[3]), cells)
        layout = grid_layout(tensors["extent"], tuple(tensors["resolutions"].tolist()))
        decoder = Decoder(**{name: tensors[f"decoder_{name}"].copy() for name in Decoder._fields})
        density_bias, step_cells, _, near = tensors["sampling"].tolist()
        empty = np.zeros(layout.num_values, dtype=np.float32)
        space = _space_from_tensors(tensors)
        field = GridField(
            layout=layout,
            table=empty,
            decoder=decoder,
            occupancy=occupancy,
            density_bias=density_bias,
            step_cells=step_cells,
            near=near,
            space=space,
        )
        return expand(field, tensors["grid"])
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"this checkpoint does not hold a grid field ({error}); delete it and train again") from error


def _space_from_tensors(tensors: Mapping[str, np.ndarray]) -> Space:
    projective, near, depth = tensors["projection"]
    if projective:
        R, center = tensors["projection_R"].copy(), tensors["projection_center"].copy()
        return projective_space(Projection(R, center, np.float32(near), np.float32(depth)))
    contracted = tensors["sampling"][2]
    return contracted_space(0.25 * float(np.max(tensors["extent"]))) if contracted else box_space()


def reachable_vertices(field: GridField) -> Bool[np.ndarray, "v"]:
    """Which vertices of all levels, in the order of the table, an occupied cell needs."""
    parts = []
    cells, cell_size = field.occupancy.cells, field.occupancy.cell_size
    for level in range(field.layout.num_levels):
        spacing = field.layout.spacings[level]
        needed: np.ndarray = cells
        for axis in range(3):
            # Vertex i matters to points in ((i - 1) spacing, (i + 1) spacing).
            index = np.arange(field.layout.sizes[level][axis])
            low = np.clip(np.floor((index - 1) * spacing / cell_size - 1e-3), 0, cells.shape[axis]).astype(np.int64)
            high = np.clip(np.ceil((index + 1) * spacing / cell_size + 1e-3), 0, cells.shape[axis]).astype(np.int64)
            zero = np.zeros_like(np.take(needed, [0], axis), dtype=np.int32)
            counts = np.concatenate([zero, np.cumsum(needed, axis=axis, dtype=np.int32)], axis)
            needed = np.take(counts, high, axis) > np.take(counts, np.minimum(low, high), axis)
        parts.append(needed.reshape(-1))
    return np.concatenate(parts)


def _vertices(layout: GridLayout, table: np.ndarray) -> list[np.ndarray]:
    return [layout.level(table, level).reshape(-1, CHANNELS) for level in range(layout.num_levels)]


def clear_unreachable(field: GridField, *tables: Float[np.ndarray, "t"]) -> None:
    """Set what no ray can reach to 0, in tables laid out like the field's: a checkpoint does not keep it."""
    reachable, start = reachable_vertices(field), 0
    for level in range(field.layout.num_levels):
        size = int(np.prod(field.layout.sizes[level]))
        for table in tables:
            vertices = field.layout.level(table, level).reshape(-1, CHANNELS)
            vertices[~reachable[start : start + size]] = 0.0
        start += size


def compress(
    field: GridField, table: Float[np.ndarray, "t"], reachable: Bool[np.ndarray, "v"]
) -> Float[np.ndarray, "k 4"]:
    """The reachable vertices of a table laid out like the field's."""
    parts, start = [], 0
    for level in _vertices(field.layout, table):
        parts.append(level[reachable[start : start + len(level)]])
        start += len(level)
    return np.concatenate(parts)


def expand(field: GridField, vertices: Float[np.ndarray, "v 4"]) -> GridField:
    """The field with its table filled from `compress`; other vertices are 0."""
    table = np.zeros(field.layout.num_values, dtype=np.float32)
    reachable, start, row = reachable_vertices(field), 0, 0
    for level in _vertices(field.layout, table):
        here = reachable[start : start + len(level)]
        count = int(np.count_nonzero(here))
        level[here] = vertices[row : row + count]
        start, row = start + len(level), row + count
    if row != len(vertices):
        raise ValueError(f"{len(vertices)} vertices were stored for {row} that can be reached")
    return replace(field, table=table)
