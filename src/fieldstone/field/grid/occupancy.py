"""Where a field may have density: cells of a box, found from alpha masks or from the field itself.

The visual hull is what all silhouettes allow: a point of the object is inside the silhouette of every photo that
shows it, so whatever projects onto transparent pixels is empty before training starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.field.grid.occupancy_numba import carve_numba
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3

MAX_DISTANCE = 16
"""Empty cells know their distance to the next occupied one up to this many cells."""

BRICK = 4
"""Cells along the side of a brick."""

MASK_SIDE = 256
"""Masks are reduced to this many blocks along their longer side before carving."""

COARSEST_CELLS = 32
"""Carving starts with this many cells along the longest side and doubles them."""


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Cubic cells of a box; `cells[i, j, k]` covers lower + [i, i + 1) x [j, j + 1) x [k, k + 1) times `cell_size`."""

    lower: Float[np.ndarray, "3"]
    cell_size: float
    cells: Bool[np.ndarray, "x y z"]

    @property
    def extent(self) -> Float[np.ndarray, "3"]:
        """Size of the box."""
        return np.array(self.cells.shape) * self.cell_size

    def centers(self) -> Float[np.ndarray, "n 3"]:
        """Centres of all cells, in C order."""
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.cells.shape), indexing="ij"), axis=-1)
        return self.lower + (index.reshape(-1, 3) + 0.5) * self.cell_size

    def trimmed(self) -> Occupancy:
        """The box around the occupied cells, one empty cell wide on each side where there was one.

        A box without any occupied cell stays as it is.
        """
        occupied = np.argwhere(self.cells)
        if not len(occupied):
            return self
        low = np.maximum(occupied.min(axis=0) - 1, 0)
        high = np.minimum(occupied.max(axis=0) + 2, self.cells.shape)
        cells = self.cells[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        return Occupancy(self.lower + low * self.cell_size, self.cell_size, np.ascontiguousarray(cells))

    def resampled(self, cell_size: float, extent: Float[np.ndarray, "3"] | None = None) -> Occupancy:
        """The same box in cells of another size: occupied where a cell of the old ones at its place was.

        Args:
            extent: What the new cells have to cover; None: all old cells.
        """
        extent = self.extent if extent is None else extent
        shape = np.maximum(np.ceil(extent / cell_size - 1e-4).astype(np.int64), 1)
        if cell_size == self.cell_size and tuple(shape.tolist()) == self.cells.shape:
            return self
        parts = []
        for axis in range(3):
            low = np.floor(np.arange(shape[axis]) * cell_size / self.cell_size + 1e-6).astype(np.int64)
            high = np.ceil((np.arange(shape[axis]) + 1) * cell_size / self.cell_size - 1e-6).astype(np.int64)
            top = self.cells.shape[axis]
            parts.append((np.minimum(low, top - 1), np.minimum(np.maximum(high, low + 1), top)))
        cells = self.cells
        for axis, (low, high) in enumerate(parts):
            counts = np.concatenate(
                [np.zeros_like(np.take(cells, [0], axis), dtype=np.int64), np.cumsum(cells, axis=axis, dtype=np.int64)],
                axis,
            )
            cells = np.take(counts, high, axis) > np.take(counts, np.minimum(low, high - 1), axis)
        return Occupancy(self.lower, cell_size, np.ascontiguousarray(cells))


def full_box(lower: Float[np.ndarray, "3"], extent: Float[np.ndarray, "3"], num_cells: int) -> Occupancy:
    """Everything occupied, `num_cells` along the longest side."""
    cell_size = float(np.max(extent)) / num_cells
    shape = np.maximum(np.ceil(extent / cell_size - 1e-6).astype(np.int64), 1)
    return Occupancy(lower, cell_size, np.ones(tuple(shape.tolist()), dtype=bool))


def cell_distances(cells: Bool[np.ndarray, "x y z"]) -> UInt8[np.ndarray, "x y z"]:
    """Largest coordinate difference to the nearest occupied cell, at most `MAX_DISTANCE`; 0 where occupied.

    All cells within a distance of less than d of a cell with value d are empty.
    """
    distance = np.zeros(cells.shape, dtype=np.uint8)
    reached = cells
    for _ in range(MAX_DISTANCE):
        distance += ~reached
        reached = grown_by_one(reached)
    return distance


def grown_by_one(cells: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """The cells and all that touch them, by a corner at least."""
    for axis in range(3):
        along = np.moveaxis(cells, axis, 0)
        grown = along.copy(order="K")
        grown[1:] |= along[:-1]
        grown[:-1] |= along[1:]
        cells = np.moveaxis(grown, 0, axis)
    return cells


def in_bricks(values: UInt8[np.ndarray, "x y z"]) -> UInt8[np.ndarray, "n"]:
    """Values of cells brick by brick, see `march_numba.Box`; the last bricks are filled up with 0."""
    bricks = -(-np.array(values.shape) // BRICK)
    padded = np.pad(values, [(0, BRICK * n - size) for n, size in zip(bricks.tolist(), values.shape, strict=True)])
    split = padded.reshape(bricks[0], BRICK, bricks[1], BRICK, bricks[2], BRICK)
    return np.ascontiguousarray(split.transpose(0, 2, 4, 1, 3, 5)).reshape(-1)


def visual_hull(
    box: Occupancy,
    masks: Sequence[Bool[np.ndarray, "_ _"]],
    cameras: Sequence[Camera],
    cam_from_box: Sequence[Rigid3],
    num_cells: int,
    executor: Executor,
) -> Occupancy:
    """What the silhouettes leave of a box, in `num_cells` cells along its longest side.

    A cell falls when the disc that contains its projection lies on transparent pixels of one photo. Points outside of
    a photo or behind it say nothing, and neither do photos with lens distortion.

    Args:
        box: What to carve; its cells are refined by halving.
        masks: Where each photo is not fully transparent.

    Source:
        `kutulakos2000`, section 3, for silhouettes.
    """
    straight = [v for v, camera in enumerate(cameras) if camera.model in ("PINHOLE", "SIMPLE_PINHOLE")]
    if not straight:
        return box
    poses = np.stack([np.column_stack([cam_from_box[v].R, cam_from_box[v].t]) for v in straight])
    pooled = [_pooled(masks[v]) for v in straight]
    scales = np.array([factor for _, factor in pooled], dtype=np.float64)
    intrinsics = np.array([[*cameras[v].focal, *cameras[v].principal_point] for v in straight]) / scales[:, None]
    sizes = np.array([[cameras[v].width, cameras[v].height] for v in straight]) / scales[:, None]
    sums = _summed([mask for mask, _ in pooled])
    occupancy, count = box, min(COARSEST_CELLS, num_cells)
    while True:
        occupancy = occupancy.resampled(float(np.max(box.extent)) / count)
        cells, lower, cell_size = occupancy.cells.copy(), occupancy.lower, occupancy.cell_size
        bounds = np.linspace(0, len(cells), 17).astype(np.int64)

        def carve(n: int, cells=cells, lower=lower, cell_size=cell_size, bounds=bounds) -> None:
            carve_numba(cells, lower, cell_size, poses, intrinsics, sizes, sums, bounds[n], bounds[n + 1])

        list(executor.map(carve, range(16)))
        occupancy = Occupancy(lower, cell_size, cells)
        if count == num_cells:
            return occupancy
        count = min(2 * count, num_cells)


def _pooled(mask: Bool[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h2 w2"], int]:
    """The mask in square blocks, set where any pixel is, with at most `MASK_SIDE` along each side."""
    factor = -(-max(mask.shape) // MASK_SIDE)
    height, width = (-(-side // factor) for side in mask.shape)
    padded = np.zeros((height * factor, width * factor), dtype=bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    return np.any(padded.reshape(height, factor, width, factor), axis=(1, 3)), factor


def _summed(masks: Sequence[Bool[np.ndarray, "_ _"]]) -> Int[np.ndarray, "v h2 w2"]:
    """Number of set pixels above and left of each corner; photos of different sizes are padded."""
    height, width = (max(mask.shape[axis] for mask in masks) for axis in (0, 1))
    sums = np.zeros((len(masks), height + 2, width + 2), dtype=np.int32)
    for n, mask in enumerate(masks):
        sums[n, 1 : mask.shape[0] + 1, 1 : mask.shape[1] + 1] = mask
    return sums.cumsum(axis=1, dtype=np.int32).cumsum(axis=2, dtype=np.int32)
