"""One damped step of bundle adjustment through the Schur complement, on the compiled kernels."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from fieldstone.solve.algebra.tile_cholesky_numba import MAX_ROWS
from fieldstone.solve.bundle.layout import BundleLayout
from fieldstone.solve.bundle.linearize_numba import gather_cameras_numba, linearize_points_numba, linearize_views_numba
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.schur_numba import (
    eliminate_points_numba,
    mark_shared_tiles_numba,
    move_points_numba,
    move_views_numba,
    reduce_border_numba,
    reduce_rows_numba,
)
from fieldstone.solve.projection.projection_numba import MAX_CAMERA_PARAMS

MAX_SINGLE_TILE = 128
"""Reduced systems up to this size are factored as one tile, without BLAS."""
FACTOR_PER_OBSERVATION = 1.5e4
"""Multiply-adds of a factorisation, for each observation, beyond which conjugate gradients take less time."""
MAX_FACTOR_BYTES = 4e9
"""Larger factors are not stored."""


@dataclass(frozen=True, eq=False)
class Values:
    """What is being solved for: poses, points (in the layout's order), camera parameters (padded)."""

    R: Float[np.ndarray, "v 3 3"]
    t: Float[np.ndarray, "v 3"]
    points: Float[np.ndarray, "p 3"]
    params: Float[np.ndarray, "c 12"]


@dataclass(frozen=True)
class Workers:
    """Runs a kernel over ranges, in this thread or in several; the ranges never change a result."""

    pool: ThreadPoolExecutor | None
    threads: int

    def over(self, kernel: Callable, bounds: list[tuple[int, ...]], *args) -> None:
        """Call `kernel(*bound, *args)` for every bound and wait."""
        if self.pool is None or len(bounds) == 1:
            for bound in bounds:
                kernel(*bound, *args)
            return
        futures = [self.pool.submit(kernel, *bound, *args) for bound in bounds]
        for future in futures:
            future.result()

    def split(self, starts: Int[np.ndarray, "n_and_one"]) -> list[tuple[int, ...]]:
        """Ranges of items with about equally many observations."""
        count = len(starts) - 1
        if self.threads == 1:
            return [(0, count)]
        cuts = np.searchsorted(starts, np.linspace(0, starts[-1], self.threads + 1)[1:-1])
        edges = [0, *cuts.tolist(), count]
        return [(a, b) for a, b in pairwise(edges) if b > a] or [(0, count)]


@dataclass(frozen=True, eq=False)
class TilePattern:
    """Which tiles of the reduced system exist; tiles beyond `num_given` appear only in the factor.

    Where the system is not factored, the tiles are those of its block diagonal.
    """

    per_tile: int
    index: Int[np.ndarray, "t t"]
    num_given: int
    num_tiles: int
    num_products: int
    """Tile products of one factorisation."""
    direct: bool = True
    """Whether the system is factored, or solved by conjugate gradients."""

    @property
    def given_index(self) -> Int[np.ndarray, "t t"]:
        """`index` without the tiles that only factorisation fills in."""
        return np.where(self.index < self.num_given, self.index, -1)


@dataclass(frozen=True, eq=False)
class Linearization:
    """Residuals, Jacobians and point blocks at one set of values; see `linearize_points_numba`."""

    B: Float[np.ndarray, "o 2 3"]
    residual: Float[np.ndarray, "o 2"]
    J_camera: Float[np.ndarray, "o 2 a"]
    V: Float[np.ndarray, "p 6"]
    g_point: Float[np.ndarray, "p 3"]
    cost: Float[np.ndarray, "p"]


@dataclass(frozen=True, eq=False)
class Workspace:
    """Buffers that every step writes anew; see `schur_numba`."""

    U_view: Float[np.ndarray, "l n n"]
    g_view: Float[np.ndarray, "l n"]
    L_inv: Float[np.ndarray, "p 6"]
    y: Float[np.ndarray, "p 3"]
    Z: Float[np.ndarray, "o 3 h"]
    Z_border: Float[np.ndarray, "e 3 a"]
    decrease: Float[np.ndarray, "p"]
    tiles: Float[np.ndarray, "t k k b b"]
    L: Float[np.ndarray, "f m m"]
    diagonal_inverse: Float[np.ndarray, "r m m"]


@dataclass(frozen=True, eq=False)
class CameraSystem:
    """Normal equations of the cameras before the points are eliminated."""

    U: Float[np.ndarray, "s b b"]
    g: Float[np.ndarray, "s b"]
    cross: Float[np.ndarray, "n s b"]
    corner: Float[np.ndarray, "n n"]
    g_border: Float[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class ReducedSystem:
    """Cameras after the points are eliminated; the blocks of views are in `Workspace.tiles`."""

    border: Float[np.ndarray, "n s b"]
    rhs: Float[np.ndarray, "s b"]
    corner: Float[np.ndarray, "n n"]
    """Lower triangle."""
    rhs_border: Float[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class Step:
    """Tangent of the cameras, and the decrease of the cost that their linear model promises."""

    dx: Float[np.ndarray, "s b"]
    dx_border: Float[np.ndarray, "n"]
    decrease: float


def start_values(problem: BundleProblem, layout: BundleLayout) -> Values:
    """The values that a problem starts from."""
    params = np.zeros((len(problem.cameras), MAX_CAMERA_PARAMS))
    for row, camera in zip(params, problem.cameras, strict=True):
        row[: len(camera.params)] = camera.params
    return Values(
        np.ascontiguousarray(problem.cam_from_world.R, dtype=np.float64),
        np.ascontiguousarray(problem.cam_from_world.t, dtype=np.float64),
        np.ascontiguousarray(problem.points[layout.point_order], dtype=np.float64),
        params,
    )


def tile_pattern(layout: BundleLayout, factor_per_observation: float | None = FACTOR_PER_OBSERVATION) -> TilePattern:
    """Tiles of slots that share points, and those that factorisation fills in.

    Args:
        factor_per_observation: Multiply-adds of a factorisation that is worth it, for each observation; where it takes
            more the pattern is that of the block diagonal. None: the factor is needed, whatever it takes.
    """
    limit = MAX_SINGLE_TILE if layout.num_columns <= MAX_SINGLE_TILE else MAX_ROWS
    per_tile = max(1, min(limit // layout.block, layout.num_slots))
    count = -(-layout.num_slots // per_tile)
    exists = np.eye(count, dtype=bool)
    if count > 1:
        mark_shared_tiles_numba(layout.point_start, layout.slot, layout.free_point, per_tile, exists)
    index = np.full((count, count), -1)
    index[exists] = np.arange(exists.sum())
    num_given = num_tiles = int(exists.sum())
    for k in range(count):
        rows = k + 1 + np.flatnonzero(index[k + 1 :, k] >= 0)
        i, j = np.meshgrid(rows, rows, indexing="ij")
        fill = (i >= j) & (index[i, j] < 0)
        index[i[fill], j[fill]] = num_tiles + np.arange(fill.sum())
        num_tiles += int(fill.sum())
    per_column = np.sum(np.tril(index >= 0, -1), axis=0)
    num_products = int(np.sum(per_column * (per_column + 3) // 2))
    size = per_tile * layout.block
    too_dear = factor_per_observation is not None and (
        num_products * size**3 > factor_per_observation * len(layout.view) or 8 * num_tiles * size**2 > MAX_FACTOR_BYTES
    )
    if too_dear:
        diagonal = np.where(np.eye(count, dtype=bool), np.arange(count), -1)
        return TilePattern(per_tile, diagonal, count, count, 0, direct=False)
    return TilePattern(per_tile, index, num_given, num_tiles, num_products)


def allocate_linearization(layout: BundleLayout) -> Linearization:
    """Buffers for one linearisation."""
    num_obs, num_points = len(layout.view), len(layout.free_point)
    return Linearization(
        B=np.empty((num_obs, 2, 3)),
        residual=np.empty((num_obs, 2)),
        J_camera=np.empty((num_obs, 2, layout.active.shape[1])),
        V=np.empty((num_points, 6)),
        g_point=np.empty((num_points, 3)),
        cost=np.empty(num_points),
    )


def allocate(layout: BundleLayout, pattern: TilePattern) -> Workspace:
    """Buffers for the steps of a problem."""
    num_obs, num_points, num_lists = len(layout.view), len(layout.free_point), len(layout.listed_view)
    num_active, block = layout.active.shape[1], layout.block
    size = pattern.per_tile * block
    return Workspace(
        U_view=np.empty((num_lists, 6 + num_active, 6 + num_active)),
        g_view=np.empty((num_lists, 6 + num_active)),
        L_inv=np.empty((num_points, 6)),
        y=np.empty((num_points, 3)),
        Z=np.empty((num_obs, 3, block - 3)),
        Z_border=np.empty((len(layout.entry_camera), 3, num_active)),
        decrease=np.empty(num_points),
        tiles=np.empty((pattern.num_given, pattern.per_tile, pattern.per_tile, block, block)),
        L=np.empty((pattern.num_tiles, size, size)),
        diagonal_inverse=np.empty((len(pattern.index), size, size)),
    )


def linearize(
    layout: BundleLayout, values: Values, loss: tuple[int, float], out: Linearization, workers: Workers
) -> float:
    """Fill `out` with residuals, Jacobians and point blocks; returns the cost, inf if a point is behind a camera."""
    workers.over(
        linearize_points_numba, workers.split(layout.point_start),
        layout.view, layout.point_start, layout.pixels, layout.scale_of_view, layout.camera_of_view,
        layout.model, layout.active, layout.num_active, values.R, values.t, values.points, values.params, *loss,
        out.B, out.residual, out.J_camera, out.V, out.g_point, out.cost,
    )  # fmt: skip
    return float(np.sum(out.cost))


def camera_system(
    layout: BundleLayout, values: Values, pivot: Float[np.ndarray, "3"], at: Linearization, work: Workspace,
    workers: Workers,
) -> CameraSystem:  # fmt: skip
    """Normal equations of poses and cameras, sorted into slots and border."""
    workers.over(
        linearize_views_numba, workers.split(layout.list_start),
        layout.list_start, layout.list_obs, layout.listed_view, layout.camera_of_view, layout.num_active,
        layout.point, values.points, pivot, at.B, at.residual, at.J_camera, work.U_view, work.g_view,
    )  # fmt: skip
    s, b, n = layout.num_slots, layout.block, layout.num_border
    system = CameraSystem(np.empty((s, b, b)), np.empty((s, b)), np.zeros((n, s, b)), np.zeros((n, n)), np.zeros(n))
    gather_cameras_numba(
        s, layout.listed_view, layout.camera_of_view, layout.num_active, layout.own, layout.border_of_camera,
        work.U_view, work.g_view, system.U, system.g, system.cross, system.corner, system.g_border,
    )  # fmt: skip
    return system


def reduce_system(
    layout: BundleLayout, pattern: TilePattern, values: Values, pivot: Float[np.ndarray, "3"], at: Linearization,
    system: CameraSystem, damping: float, work: Workspace, workers: Workers,
) -> ReducedSystem:  # fmt: skip
    """Eliminate the points: the damped reduced camera system, its view blocks in `work.tiles`."""
    workers.over(
        eliminate_points_numba, workers.split(layout.point_start),
        layout.view, layout.slot, layout.point_start, layout.camera_of_view, layout.num_active, layout.own,
        layout.entry_start, layout.entry_of_obs, layout.free_point, at.B, at.J_camera,
        at.V, at.g_point, damping, work.L_inv, work.y, work.Z, work.Z_border,
    )  # fmt: skip
    s, b, n = layout.num_slots, layout.block, layout.num_border
    border, rhs = np.empty((n, s, b)), np.empty((s, b))
    workers.over(
        reduce_rows_numba, [(k, s, workers.threads) for k in range(workers.threads)],
        layout.list_start, layout.list_obs, layout.slot, layout.point, layout.point_start, layout.free_point,
        layout.entry_start, layout.entry_camera, layout.num_active, layout.border_of_camera, pattern.given_index,
        work.tiles, values.points, pivot, system.U, system.g, system.cross, damping, work.y, work.Z, work.Z_border,
        border, rhs,
    )  # fmt: skip
    corner = system.corner + damping * np.diag(np.diag(system.corner))
    rhs_border = -system.g_border
    if n:
        reduce_border_numba(
            layout.border_start, layout.border_entries, layout.entry_start, layout.entry_camera, layout.entry_point,
            layout.num_active, layout.border_of_camera, work.Z_border, work.y, corner, rhs_border,
        )  # fmt: skip
    return ReducedSystem(border, rhs, corner, rhs_border)


def move(
    layout: BundleLayout, values: Values, pivot: Float[np.ndarray, "3"], at: Linearization, step: Step, damping: float,
    work: Workspace, workers: Workers,
) -> tuple[Values, float]:  # fmt: skip
    """The values after a step, and the decrease of the cost that the linear model promised."""
    R, t, params, points = values.R.copy(), values.t.copy(), values.params.copy(), np.empty_like(values.points)
    move_views_numba(layout.num_slots, layout.listed_view, pivot, step.dx, values.R, values.t, R, t)
    for c in np.flatnonzero(layout.border_of_camera >= 0):
        a, first = int(layout.num_active[c]), int(layout.border_of_camera[c])
        params[c, layout.active[c, :a]] += step.dx_border[first : first + a]
    if layout.block > 6:
        camera = layout.camera_of_view[layout.listed_view[: layout.num_slots]]
        for i in np.flatnonzero(layout.own[camera]):
            a = int(layout.num_active[camera[i]])
            params[camera[i], layout.active[camera[i], :a]] += step.dx[i, 6 : 6 + a]
    workers.over(
        move_points_numba, workers.split(layout.point_start),
        layout.slot, layout.point_start, layout.entry_start, layout.entry_camera, layout.num_active,
        layout.border_of_camera, values.points, pivot, at.V, at.g_point, damping, work.L_inv, work.y, work.Z,
        work.Z_border, step.dx, step.dx_border, points, work.decrease,
    )  # fmt: skip
    return Values(R, t, points, params), step.decrease + float(np.sum(work.decrease))
