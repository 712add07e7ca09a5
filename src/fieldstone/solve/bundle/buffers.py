"""The arrays that the compiled solver reads and writes: values, linearisations, and the systems of one step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fieldstone.solve.bundle.layout import BundleLayout
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.tile_pattern import TilePattern
from fieldstone.solve.projection.projection_numba import MAX_CAMERA_PARAMS


class Values(NamedTuple):
    """What is being solved for: poses, points (in the layout's order), camera parameters (padded)."""

    R: Float[np.ndarray, "v 3 3"]
    t: Float[np.ndarray, "v 3"]
    points: Float[np.ndarray, "p 3"]
    params: Float[np.ndarray, "c 12"]


class Linearization(NamedTuple):
    """Residuals, Jacobians and point blocks at one set of values; see `linearize_points_numba`."""

    B: Float[np.ndarray, "o 2 3"]
    residual: Float[np.ndarray, "o 2"]
    J_camera: Float[np.ndarray, "o 2 a"]
    V: Float[np.ndarray, "p 6"]
    g_point: Float[np.ndarray, "p 3"]
    cost: Float[np.ndarray, "p"]


class CameraSystem(NamedTuple):
    """Normal equations of poses and intrinsics before the points are eliminated.

    [[U, cross^T], [cross, corner]] with the gradient (g, g_shared): free views first, then shared intrinsics.
    """

    U: Float[np.ndarray, "s b b"]
    g: Float[np.ndarray, "s b"]
    cross: Float[np.ndarray, "n s b"]
    corner: Float[np.ndarray, "n n"]
    g_shared: Float[np.ndarray, "n"]


class ReducedSystem(NamedTuple):
    """The same after the points are eliminated: [[S, border^T], [border, corner]] dx = (rhs, rhs_shared)."""

    tiles: Float[np.ndarray, "t k k b b"]
    """Blocks of S, those of `per_tile` neighbouring views in one tile."""
    border: Float[np.ndarray, "n s b"]
    rhs: Float[np.ndarray, "s b"]
    corner: Float[np.ndarray, "n n"]
    """Lower triangle."""
    rhs_shared: Float[np.ndarray, "n"]


class Step(NamedTuple):
    """Tangents of the free views, steps of shared intrinsics, and the decrease of the cost promised by both."""

    dx: Float[np.ndarray, "s b"]
    dx_shared: Float[np.ndarray, "n"]
    decrease: float


class SolverBuffers(NamedTuple):
    """Buffers that every step writes anew; see `schur_numba`."""

    U_view: Float[np.ndarray, "l n n"]
    g_view: Float[np.ndarray, "l n"]
    L_inv: Float[np.ndarray, "p 6"]
    y: Float[np.ndarray, "p 3"]
    Z: Float[np.ndarray, "o 3 h"]
    Z_shared: Float[np.ndarray, "e 3 a"]
    decrease: Float[np.ndarray, "p"]
    reduced: ReducedSystem
    L: Float[np.ndarray, "f m m"]
    diagonal_inverse: Float[np.ndarray, "r m m"]


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


def allocate_linearization(layout: BundleLayout) -> Linearization:
    """Buffers for one linearisation."""
    num_obs, num_points = len(layout.view_of_obs), len(layout.free_point)
    return Linearization(
        B=np.empty((num_obs, 2, 3)),
        residual=np.empty((num_obs, 2)),
        J_camera=np.empty((num_obs, 2, layout.refined.shape[1])),
        V=np.empty((num_points, 6)),
        g_point=np.empty((num_points, 3)),
        cost=np.empty(num_points),
    )


def zero_camera_system(layout: BundleLayout) -> CameraSystem:
    """A system that views are to be gathered into."""
    s, b, n = layout.num_free_views, layout.block, layout.num_shared
    return CameraSystem(np.empty((s, b, b)), np.empty((s, b)), np.zeros((n, s, b)), np.zeros((n, n)), np.zeros(n))


def allocate_buffers(layout: BundleLayout, pattern: TilePattern) -> SolverBuffers:
    """Buffers for the steps of a problem."""
    num_obs, num_points, num_views = len(layout.view_of_obs), len(layout.free_point), len(layout.view_order)
    num_params, block, k = layout.refined.shape[1], layout.block, pattern.per_tile
    return SolverBuffers(
        U_view=np.empty((num_views, 6 + num_params, 6 + num_params)),
        g_view=np.empty((num_views, 6 + num_params)),
        L_inv=np.empty((num_points, 6)),
        y=np.empty((num_points, 3)),
        Z=np.empty((num_obs, 3, block - 3)),
        Z_shared=np.empty((len(layout.couplings.camera), 3, num_params)),
        decrease=np.empty(num_points),
        reduced=ReducedSystem(
            tiles=np.empty((pattern.num_given, k, k, block, block)),
            border=np.empty((layout.num_shared, layout.num_free_views, block)),
            rhs=np.empty((layout.num_free_views, block)),
            corner=np.empty((layout.num_shared, layout.num_shared)),
            rhs_shared=np.empty(layout.num_shared),
        ),
        L=np.empty((pattern.num_tiles, k * block, k * block)),
        diagonal_inverse=np.empty((len(pattern.index), k * block, k * block)),
    )
