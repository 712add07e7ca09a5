"""How a bundle problem lies in memory for the compiled solver: sorted, dense, without Python objects.

Free views get slots 0..s-1, each with a block of `block` columns in the reduced camera system: six for the pose, then
the free parameters of the view's own camera (one that no other view uses). Parameters of cameras that several
views share, and of cameras of fixed views, form the border: a few dense rows at the end of the system.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from fieldstone.geometry.camera import CAMERA_MODELS
from fieldstone.solve.algebra.sorting_numba import border_entries_numba, counting_order_numba
from fieldstone.solve.bundle.problem import BundleProblem

MIN_VIEWS_TO_ORDER = 100


@dataclass(frozen=True, eq=False)
class BundleLayout:
    """Index arrays of one problem; observations sorted by point, then slot (fixed views first).

    Points are numbered by the first slot that sees them, so that what a slot reads lies close together. Observations
    of points that start behind their camera are left out.
    """

    point_order: Int[np.ndarray, "p"]
    """Number in the problem of each point here."""
    view: Int[np.ndarray, "o"]
    point: Int[np.ndarray, "o"]
    slot: Int[np.ndarray, "o"]
    """-1 for observations of fixed views."""
    pixels: Float[np.ndarray, "o 2"]
    scale_of_view: Float[np.ndarray, "v"]
    """What residuals of each view are divided by."""
    point_start: Int[np.ndarray, "p_and_one"]
    listed_view: Int[np.ndarray, "l"]
    """The view of each slot, then the fixed views."""
    list_start: Int[np.ndarray, "l_and_one"]
    list_obs: Int[np.ndarray, "o"]
    """Observations of listed view i, sorted by point: `list_obs[list_start[i]:list_start[i + 1]]`."""
    num_slots: int
    """Number of free views."""
    camera_of_view: Int[np.ndarray, "v"]
    model: Int[np.ndarray, "c"]
    active: Int[np.ndarray, "c a"]
    """Free parameters of each camera, in the order of their columns; -1 beyond the last."""
    num_active: Int[np.ndarray, "c"]
    own: Bool[np.ndarray, "c"]
    """Cameras whose parameters stand in the block of their only view."""
    block: int
    border_of_camera: Int[np.ndarray, "c"]
    """First border row of a camera's parameters, -1 where it has none."""
    num_border: int
    entry_start: Int[np.ndarray, "p_and_one"]
    """Border entries: the distinct border cameras that see a point."""
    entry_camera: Int[np.ndarray, "e"]
    entry_of_obs: Int[np.ndarray, "o"]
    border_start: Int[np.ndarray, "c_and_one"]
    border_entries: Int[np.ndarray, "e"]
    """Entries of camera c: `border_entries[border_start[c]:border_start[c + 1]]`."""
    entry_point: Int[np.ndarray, "e"]
    free_point: Bool[np.ndarray, "p"]

    @property
    def two_focal(self) -> Bool[np.ndarray, "c"]:
        """Cameras whose first two parameters are fx and fy."""
        return np.array([spec.num_focal == 2 for spec in CAMERA_MODELS.values()])[self.model]

    @property
    def num_columns(self) -> int:
        """Size of the reduced camera system without its border."""
        return self.num_slots * self.block


def lay_out(problem: BundleProblem, usable: Bool[np.ndarray, "o"]) -> BundleLayout:
    """Sort the usable observations and assign every free parameter its column."""
    num_points = len(problem.points)
    active, num_active = _active_params(problem)
    rows = np.flatnonzero(usable)
    has_rows = np.bincount(problem.view[rows], minlength=problem.num_views) > 0
    free_views = np.flatnonzero(~problem.fixed_views & has_rows)
    view_of_slot = free_views[_ordering(problem, rows, free_views)]
    slot_of_view = np.full(problem.num_views, -1)
    slot_of_view[view_of_slot] = np.arange(len(view_of_slot))

    own, border_of_camera, num_border = _place_cameras(problem, slot_of_view, num_active, has_rows)
    block = 6 + int(num_active[own].max(initial=0))

    num_slots = len(view_of_slot)
    slot = slot_of_view[problem.view[rows]]
    first_slot = np.full(num_points, num_slots)
    np.minimum.at(first_slot, problem.point[rows], np.where(slot < 0, num_slots, slot))
    point_order, _ = counting_order_numba(first_slot, num_slots + 1)
    rank = np.empty(num_points, dtype=np.int64)
    rank[point_order] = np.arange(num_points)
    by_slot, _ = counting_order_numba(slot + 1, num_slots + 1)
    by_point, point_start = counting_order_numba(rank[problem.point[rows[by_slot]]], num_points)
    order = rows[by_slot[by_point]]
    view, point = problem.view[order], rank[problem.point[order]]

    listed_view = np.concatenate([view_of_slot, np.setdiff1d(np.flatnonzero(has_rows), view_of_slot)])
    place_in_list = np.full(problem.num_views, -1)
    place_in_list[listed_view] = np.arange(len(listed_view))
    list_obs, list_start = counting_order_numba(place_in_list[view], len(listed_view))
    camera = problem.camera_of_view[view]
    entry_of_obs, entry_start, entry_camera = border_entries_numba(point_start, camera, border_of_camera)
    border_entries, border_start = counting_order_numba(entry_camera, len(problem.cameras))
    return BundleLayout(
        point_order=point_order,
        view=view,
        point=point,
        slot=slot_of_view[view],
        pixels=np.ascontiguousarray(problem.pixels[order], dtype=np.float64),
        scale_of_view=np.ascontiguousarray(problem.scale_of_view, dtype=np.float64),
        point_start=point_start,
        listed_view=listed_view,
        list_start=list_start,
        list_obs=list_obs,
        num_slots=num_slots,
        camera_of_view=np.asarray(problem.camera_of_view, dtype=np.int64),
        model=np.array([camera.spec.colmap_id for camera in problem.cameras], dtype=np.int64),
        active=active,
        num_active=num_active,
        own=own,
        block=block,
        border_of_camera=border_of_camera,
        num_border=num_border,
        entry_start=entry_start,
        entry_camera=entry_camera,
        entry_of_obs=entry_of_obs,
        border_start=border_start,
        border_entries=border_entries,
        entry_point=np.repeat(np.arange(num_points), np.diff(entry_start)),
        free_point=~problem.fixed_points[point_order],
    )


def _active_params(problem: BundleProblem) -> tuple[Int[np.ndarray, "c a"], Int[np.ndarray, "c"]]:
    """Indices of the free parameters of each camera, and how many there are."""
    num_active = np.array([int(mask.sum()) for mask in problem.refine], dtype=np.int64)
    active = np.full((len(problem.cameras), int(num_active.max(initial=0))), -1)
    for row, mask in zip(active, problem.refine, strict=True):
        row[: mask.sum()] = np.flatnonzero(mask)
    return active, num_active


def _place_cameras(
    problem: BundleProblem,
    slot_of_view: Int[np.ndarray, "v"],
    num_active: Int[np.ndarray, "c"],
    has_rows: Bool[np.ndarray, "v"],
) -> tuple[Bool[np.ndarray, "c"], Int[np.ndarray, "c"], int]:
    """Which cameras stand in their view's block, and the first border row of the others."""
    camera_of_used = problem.camera_of_view[has_rows]
    num_cameras = len(problem.cameras)
    num_views = np.bincount(camera_of_used, minlength=num_cameras)
    num_free_views = np.bincount(problem.camera_of_view[slot_of_view >= 0], minlength=num_cameras)
    refined = (num_active > 0) & (num_views > 0)
    own = refined & (num_views == 1) & (num_free_views == 1)
    in_border = refined & ~own
    sizes = np.where(in_border, num_active, 0)
    border_of_camera = np.where(in_border, np.cumsum(sizes) - sizes, -1)
    return own, border_of_camera, int(sizes.sum())


def _ordering(
    problem: BundleProblem, rows: Int[np.ndarray, "n"], free_views: Int[np.ndarray, "s"]
) -> Int[np.ndarray, "s"]:
    """Order of the free views in which the reduced system has a small bandwidth.

    Source:
        Reverse Cuthill-McKee: `cuthill1969`.
    """
    if len(free_views) < MIN_VIEWS_TO_ORDER:
        return np.arange(len(free_views))
    ones = np.ones(len(rows), dtype=np.float32)
    seen = coo_matrix((ones, (problem.view[rows], problem.point[rows])), shape=(problem.num_views, len(problem.points)))
    free_rows = seen.tocsr()[free_views]
    covisible = (free_rows @ free_rows.T).tocsr()
    return np.asarray(reverse_cuthill_mckee(covisible, symmetric_mode=True), dtype=np.int64)
