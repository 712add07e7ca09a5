"""The fast field: feature grids, a small decoder and an occupancy, as one value that renders and can be saved."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.errors import InputError
from fieldstone.field.base.projection import Projection
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, RenderedRays
from fieldstone.field.base.space import (
    Space,
    box_space,
    contracted_space,
    expected_distance,
    marched_rays,
    projective_space,
)
from fieldstone.field.grid.decoder import HIDDEN, Decoder, decode
from fieldstone.field.grid.decoder_numba import decode_directions, decode_numba
from fieldstone.field.grid.interpolation_numba import interpolate_numba
from fieldstone.field.grid.layout import CHANNELS, GridLayout, grid_layout, interpolate
from fieldstone.field.grid.march_numba import (
    MAX_RAW,
    MIN_RAW,
    Box,
    March,
    Samples,
    composite_numba,
    march_rays,
)  # fmt: skip
from fieldstone.field.grid.occupancy import Occupancy, cell_distances, in_bricks
from fieldstone.scene.rays import Rays

REFERENCE_CELLS = 128
"""Density 1 takes the share 1 - 1/e of the light on 1/128 of the longest side of the box."""

RENDER_MIN_WEIGHT, RENDER_MIN_LIGHT = 4e-3, 1e-2
"""As where open scenes are learned. Lego at 400x400: 0.008 dB less than with 1e-3 and 3e-3, 1.13 times as fast."""

FOREVER = np.float32(1e9)

RAYS_PER_TILE = 1024
SAMPLES_PER_TILE = 8192


@dataclass(frozen=True, eq=False)
class FastField:
    """What training has found. Lengths are those of the field's frame (normalised)."""

    layout: GridLayout
    table: Float[np.ndarray, "t"]
    decoder: Decoder
    occupancy: Occupancy
    raw_offset: float
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

    def march(self, min_weight: float, min_light: float) -> March:
        """How rays are sampled, with the thresholds of the caller."""
        step = float(self.layout.spacings[-1]) * self.step_cells
        return March(
            np.float32(step), np.float32(self.raw_offset), np.float32(self.step_depth),
            np.float32(min_weight), np.float32(min_light), np.float32(self.near),
        )  # fmt: skip

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
        raw = self.raw_offset + values[:, ::CHANNELS].sum(axis=1)
        out = np.zeros(len(points))
        out[inside] = np.where(raw > MIN_RAW, np.exp(np.minimum(raw, MAX_RAW)), 0.0) / self.reference_length
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
            "sampling": np.array([self.raw_offset, self.step_cells, float(self.space.is_contracted), self.near]),
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
        occupancy.lower.astype(np.float32),
        extent.astype(np.float32),
        in_bricks(cell_distances(occupancy.cells)),
        np.array(occupancy.cells.shape, dtype=np.int64),
        np.float32(occupancy.cell_size),
        space,
    )


def field_from_tensors(tensors: Mapping[str, np.ndarray]) -> FastField:
    """The field of `FastField.to_tensors`.

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
        raw_offset, step_cells, _, near = tensors["sampling"].tolist()
        empty = np.zeros(layout.num_values, dtype=np.float32)
        space = _space_from_tensors(tensors)
        field = FastField(layout, empty, decoder, occupancy, raw_offset, step_cells, near, space)
        return expand(field, tensors["grid"])
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"this checkpoint does not hold a fast field ({error}); delete it and train again") from error


def _space_from_tensors(tensors: Mapping[str, np.ndarray]) -> Space:
    projective, near, depth = tensors["projection"]
    if projective:
        R, center = tensors["projection_R"].copy(), tensors["projection_center"].copy()
        return projective_space(Projection(R, center, np.float32(near), np.float32(depth)))
    contracted = tensors["sampling"][2]
    return contracted_space(0.25 * float(np.max(tensors["extent"]))) if contracted else box_space()


def reachable_vertices(field: FastField) -> Bool[np.ndarray, "v"]:
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


def clear_unreachable(field: FastField, *tables: Float[np.ndarray, "t"]) -> None:
    """Set what no ray can reach to 0, in tables laid out like the field's: a checkpoint does not keep it."""
    reachable, start = reachable_vertices(field), 0
    for level in range(field.layout.num_levels):
        size = int(np.prod(field.layout.sizes[level]))
        for table in tables:
            vertices = field.layout.level(table, level).reshape(-1, CHANNELS)
            vertices[~reachable[start : start + size]] = 0.0
        start += size


def compress(
    field: FastField, table: Float[np.ndarray, "t"], reachable: Bool[np.ndarray, "v"]
) -> Float[np.ndarray, "k 4"]:
    """The reachable vertices of a table laid out like the field's."""
    parts, start = [], 0
    for level in _vertices(field.layout, table):
        parts.append(level[reachable[start : start + len(level)]])
        start += len(level)
    return np.concatenate(parts)


def expand(field: FastField, vertices: Float[np.ndarray, "v 4"]) -> FastField:
    """The field with its table filled from `compress`; other vertices are 0."""
    table = np.zeros(field.layout.num_values, dtype=np.float32)
    reachable, start, row = reachable_vertices(field), 0, 0
    for level in _vertices(field.layout, table):
        here = reachable[start : start + len(level)]
        count = int(np.count_nonzero(here))
        level[here] = vertices[row : row + count]
        start, row = start + len(level), row + count
    if row != len(vertices):
        raise ValueError(f"{len(vertices)} vertices for {row} places")
    return replace(field, table=table)


class _Tile(NamedTuple):
    """Room for one tile of rays; one per thread at work."""

    samples: Samples
    jitter: np.ndarray
    first: np.ndarray
    passed: np.ndarray
    per_ray: np.ndarray
    hidden: np.ndarray
    rgb: np.ndarray


def _room_for_tile(width: int) -> _Tile:
    """Rays begin half a step after the box."""
    return _Tile(
        room_for_samples(SAMPLES_PER_TILE, width),
        np.full(RAYS_PER_TILE, 0.5, np.float32),
        np.zeros(RAYS_PER_TILE + 1, np.int64),
        np.empty(RAYS_PER_TILE, np.float32),
        np.empty(RAYS_PER_TILE * HIDDEN, np.float32),
        np.empty(SAMPLES_PER_TILE * HIDDEN, np.float32),
        np.empty(SAMPLES_PER_TILE * 3, np.float32),
    )


def room_for_samples(capacity: int, width: int) -> Samples:
    """Empty arrays for so many samples."""

    def floats(count: int) -> np.ndarray:
        return np.zeros(count, dtype=np.float32)

    return Samples(
        floats(3 * capacity), floats(capacity), floats(capacity), floats(capacity), floats(capacity),
        np.zeros(capacity, dtype=np.int32), floats((capacity + 1) * width),
    )  # fmt: skip


def renderer(
    field: FastField,
    frame: FieldFrame,
    executor: Executor,
    *,
    min_weight: float = RENDER_MIN_WEIGHT,
    min_light: float = RENDER_MIN_LIGHT,
) -> RayRenderer:
    """Renders rays in normalised coordinates, tile by tile on the threads of the executor."""
    grid, box, march = field.layout.arrays(field.table), field.box(), field.march(min_weight, min_light)
    width, used = field.width, 4 * field.layout.num_levels
    far = np.float32(frame.far)

    idle: SimpleQueue[_Tile] = SimpleQueue()

    def render_tile(rays: Rays) -> RenderedRays:
        try:
            tile = idle.get_nowait()
        except Empty:
            tile = _room_for_tile(width)
        try:
            return render_with(tile, rays)
        finally:
            idle.put(tile)

    def render_with(tile: _Tile, rays: Rays) -> RenderedRays:
        count = len(rays)
        views = np.ascontiguousarray(rays.directions, dtype=np.float32)
        origins, directions, lengths = marched_rays(field.space, rays.origins, rays.directions)
        origins = np.ascontiguousarray(origins, dtype=np.float32)
        directions = np.ascontiguousarray(directions, dtype=np.float32)
        color, depth = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        opacity = np.empty(count, np.float32)
        samples, jitter, first, passed, per_ray, hidden, rgb = tile
        background = np.tile(frame.background.astype(np.float32), count)
        done = 0
        while done < count:
            o, d = origins[done:].reshape(-1), directions[done:].reshape(-1)
            num_rays, n, _ = march_rays(
                grid, box, march, o, d, jitter, FOREVER, count - done, width, samples, first, passed
            )
            decode_directions(field.decoder, views[done:].reshape(-1), num_rays, per_ray)
            decode_numba(field.decoder, n, samples.features, width, used, samples.ray, per_ray, hidden, rgb)
            rows = slice(done, done + num_rays)
            composite_numba(
                samples, num_rays, first, passed, far, background, rgb, color[rows], depth[rows], opacity[rows]
            )
            done += num_rays
        depth = expected_distance(field.space, rays.origins, rays.directions, lengths, depth, opacity, far)
        return RenderedRays(color, depth.astype(np.float32), opacity)

    def render(rays: Rays, /) -> RenderedRays:
        rows = [slice(start, start + RAYS_PER_TILE) for start in range(0, len(rays), RAYS_PER_TILE)]
        tiles = [Rays(rays.origins[r], rays.directions[r], rays.pixel_radius[r]) for r in rows]
        parts = list(executor.map(render_tile, tiles))
        if not parts:
            return RenderedRays(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        return RenderedRays(
            np.concatenate([part.rgb for part in parts]),
            np.concatenate([part.depth for part in parts]),
            np.concatenate([part.opacity for part in parts]),
        )

    return render
