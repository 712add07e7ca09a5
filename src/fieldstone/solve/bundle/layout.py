"""How a bundle problem lies in memory for the compiled solver: sorted, dense, without Python objects.

Free views are numbered 0..s-1, each with a block of `block` columns in the reduced camera system: six for the pose,
then the free parameters of its camera, where no other view uses that camera (per-view intrinsics). Shared intrinsics,
those of cameras that several views use or a fixed one, border the system: a few dense rows at its end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from fieldstone.solve.algebra.sorting_numba import counting_order_numba, coupled_cameras_numba
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.projection.projection_numba import NUM_FOCAL

MIN_VIEWS_TO_ORDER = 100


class Couplings(NamedTuple):
    """Pairs of a point and a camera with shared intrinsics that sees it, sorted by point.

    Each is a block of the normal equations that is not zero: W of `triggs2000`, section 6.1.
    """

    start: Int[np.ndarray, "p_and_one"]
    """Couplings of point p: start[p] to start[p + 1]."""
    camera: Int[np.ndarray, "e"]
    point: Int[np.ndarray, "e"]
    of_obs: Int[np.ndarray, "o"]
    """-1 for observations of cameras without shared intrinsics."""
    camera_start: Int[np.ndarray, "c_and_one"]
    of_camera: Int[np.ndarray, "e"]
    """Couplings of camera c: `of_camera[camera_start[c]:camera_start[c + 1]]`."""


class BundleLayout(NamedTuple):
    """Index arrays of one problem; observations sorted by point, then by free view (fixed views first).

    Points are numbered by the first free view that sees them, so that what a view reads lies close together.
    Observations of points that start behind their camera are left out.
    """

    point_order: Int[np.ndarray, "p"]
    """Number in the problem of each point here."""
    view_of_obs: Int[np.ndarray, "o"]
    point_of_obs: Int[np.ndarray, "o"]
    free_index: Int[np.ndarray, "o"]
    """Index among the free views of each observation's view; -1 for fixed views."""
    pixels: Float[np.ndarray, "o 2"]
    scale_of_view: Float[np.ndarray, "v"]
    """What residuals of each view are divided by."""
    point_start: Int[np.ndarray, "p_and_one"]
    view_order: Int[np.ndarray, "l"]
    """The free views by their index, then the fixed views."""
    view_start: Int[np.ndarray, "l_and_one"]
    view_obs: Int[np.ndarray, "o"]
    """Observations of view_order[i], sorted by point: `view_obs[view_start[i]:view_start[i + 1]]`."""
    num_free_views: int
    camera_of_view: Int[np.ndarray, "v"]
    model: Int[np.ndarray, "c"]
    refined: Int[np.ndarray, "c a"]
    """Free parameters of each camera, in the order of their columns; -1 beyond the last."""
    num_refined: Int[np.ndarray, "c"]
    per_view: Bool[np.ndarray, "c"]
    """Cameras with per-view intrinsics: their parameters stand in the block of their only view."""
    block: int
    shared_row: Int[np.ndarray, "c"]
    """First bordering row of a camera's shared intrinsics, -1 where it has none."""
    num_shared: int
    """Number of bordering rows."""
    couplings: Couplings
    free_point: Bool[np.ndarray, "p"]
    pivot: Float[np.ndarray, "3"]
    """Centre that poses are turned about: the median of the points."""

    @property
    def two_focal(self) -> Bool[np.ndarray, "c"]:
        """Cameras whose first two parameters are fx and fy."""
        return np.array(NUM_FOCAL)[self.model] == 2

    @property
    def num_columns(self) -> int:
        """Size of the reduced camera system without its border."""
        return self.num_free_views * self.block


def lay_out(problem: BundleProblem, usable: Bool[np.ndarray, "o"]) -> BundleLayout:
    """Sort the usable observations and assign every free parameter its column."""
    rows = np.flatnonzero(usable)
    has_rows = np.bincount(problem.view[rows], minlength=problem.num_views) > 0
    free_views = _ordered_free_views(problem, rows, np.flatnonzero(~problem.fixed_views & has_rows))
    index_of_view = _inverse(free_views, problem.num_views)

    order, point_order, point_start = _sorted_observations(problem, rows, index_of_view, len(free_views))
    view = problem.view[order].astype(np.int64, copy=False)
    point = _inverse(point_order, len(point_order))[problem.point[order]]
    view_order = np.concatenate([free_views, np.setdiff1d(np.flatnonzero(has_rows), free_views)])
    view_obs, view_start = counting_order_numba(_inverse(view_order, problem.num_views)[view], len(view_order))

    refined, num_refined = _refined_params(problem)
    per_view, shared_row, num_shared = _place_intrinsics(problem, index_of_view, num_refined, has_rows)
    seen = point_order[point_start[1:] > point_start[:-1]]
    return BundleLayout(
        point_order=point_order,
        view_of_obs=view,
        point_of_obs=point,
        free_index=index_of_view[view],
        pixels=np.ascontiguousarray(problem.pixels[order], dtype=np.float64),
        scale_of_view=np.ascontiguousarray(problem.scale_of_view, dtype=np.float64),
        point_start=point_start,
        view_order=view_order,
        view_start=view_start,
        view_obs=view_obs,
        num_free_views=len(free_views),
        camera_of_view=np.array(problem.camera_of_view, dtype=np.int64),
        model=np.array([camera.spec.colmap_id for camera in problem.cameras], dtype=np.int64),
        refined=refined,
        num_refined=num_refined,
        per_view=per_view,
        block=6 + int(num_refined[per_view].max(initial=0)),
        shared_row=shared_row,
        num_shared=num_shared,
        couplings=_couplings(point_start, problem.camera_of_view[view].astype(np.int64, copy=False), shared_row),
        free_point=~problem.fixed_points[point_order],
        pivot=np.median(problem.points[seen], axis=0) if len(seen) else np.zeros(3),
    )


def free_view_of_camera(layout: BundleLayout) -> dict[int, int]:
    """Index of the last free view of every camera that has one; of its only view, for per-view intrinsics."""
    return {int(layout.camera_of_view[v]): i for i, v in enumerate(layout.view_order[: layout.num_free_views])}


def _inverse(chosen: Int[np.ndarray, "n"], count: int) -> Int[np.ndarray, "m"]:
    """Place in `chosen` of each of 0..count-1; -1 for those that are not in it."""
    out = np.full(count, -1)
    out[chosen] = np.arange(len(chosen))
    return out


def _sorted_observations(
    problem: BundleProblem, rows: Int[np.ndarray, "n"], index_of_view: Int[np.ndarray, "v"], num_free_views: int
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "p"], Int[np.ndarray, "p_and_one"]]:
    """Observations by point, then free view; the points by the first free view that sees them; starts of points."""
    num_points = len(problem.points)
    index = index_of_view[problem.view[rows]]
    first_view = np.full(num_points, num_free_views)
    np.minimum.at(first_view, problem.point[rows], np.where(index < 0, num_free_views, index))
    point_order, _ = counting_order_numba(first_view, num_free_views + 1)
    by_view, _ = counting_order_numba(index + 1, num_free_views + 1)
    rank = _inverse(point_order, num_points)
    by_point, point_start = counting_order_numba(rank[problem.point[rows[by_view]]], num_points)
    return rows[by_view[by_point]], point_order, point_start


def _couplings(
    point_start: Int[np.ndarray, "p_and_one"], camera: Int[np.ndarray, "o"], shared_row: Int[np.ndarray, "c"]
) -> Couplings:
    """Couplings of points and shared intrinsics, from the camera of every observation."""
    of_obs, start, coupled_camera = coupled_cameras_numba(point_start, camera, shared_row)
    of_camera, camera_start = counting_order_numba(coupled_camera, len(shared_row))
    return Couplings(
        start=start,
        camera=coupled_camera,
        point=np.repeat(np.arange(len(start) - 1), np.diff(start)),
        of_obs=of_obs,
        camera_start=camera_start,
        of_camera=of_camera,
    )


def _refined_params(problem: BundleProblem) -> tuple[Int[np.ndarray, "c a"], Int[np.ndarray, "c"]]:
    """Indices of the free parameters of each camera, and how many there are."""
    num_refined = np.array([int(mask.sum()) for mask in problem.refine], dtype=np.int64)
    refined = np.full((len(problem.cameras), int(num_refined.max(initial=0))), -1)
    for row, mask in zip(refined, problem.refine, strict=True):
        row[: mask.sum()] = np.flatnonzero(mask)
    return refined, num_refined


def _place_intrinsics(
    problem: BundleProblem,
    index_of_view: Int[np.ndarray, "v"],
    num_refined: Int[np.ndarray, "c"],
    has_rows: Bool[np.ndarray, "v"],
) -> tuple[Bool[np.ndarray, "c"], Int[np.ndarray, "c"], int]:
    """Which cameras have per-view intrinsics, and the first bordering row of the others."""
    num_cameras = len(problem.cameras)
    num_views = np.bincount(problem.camera_of_view[has_rows], minlength=num_cameras)
    num_free_views = np.bincount(problem.camera_of_view[index_of_view >= 0], minlength=num_cameras)
    is_refined = (num_refined > 0) & (num_views > 0)
    per_view = is_refined & (num_views == 1) & (num_free_views == 1)
    shared = is_refined & ~per_view
    sizes = np.where(shared, num_refined, 0)
    shared_row = np.where(shared, np.cumsum(sizes) - sizes, -1)
    return per_view, shared_row, int(sizes.sum())


def _ordered_free_views(
    problem: BundleProblem, rows: Int[np.ndarray, "n"], free_views: Int[np.ndarray, "s"]
) -> Int[np.ndarray, "s"]:
    """The free views in an order in which the reduced system has a small bandwidth.

    Source:
        Reverse Cuthill-McKee: `cuthill1969`.
    """
    if len(free_views) < MIN_VIEWS_TO_ORDER:
        return free_views
    ones = np.ones(len(rows), dtype=np.float32)
    seen = coo_matrix((ones, (problem.view[rows], problem.point[rows])), shape=(problem.num_views, len(problem.points)))
    free_rows = seen.tocsr()[free_views]
    covisible = (free_rows @ free_rows.T).tocsr()
    return free_views[np.asarray(reverse_cuthill_mckee(covisible, symmetric_mode=True), dtype=np.int64)]
