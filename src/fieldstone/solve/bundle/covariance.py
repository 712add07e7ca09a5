"""How well an adjusted bundle is determined: covariances of poses, intrinsics and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rotation import skew
from fieldstone.solve.bundle.adjustment import LOSS_NUMBERS, BundleOptions, in_front
from fieldstone.solve.bundle.camera_prior import add_priors, prior_rows
from fieldstone.solve.bundle.layout import BundleLayout, lay_out
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.schur_solver import (
    Linearization,
    Workers,
    Workspace,
    allocate,
    allocate_linearization,
    camera_system,
    linearize,
    reduce_system,
    start_values,
    tile_pattern,
)

GAUGE_FREEDOMS = 7
MAX_COLUMNS = 12_000


@dataclass(frozen=True, eq=False)
class BundleCovariance:
    """Covariances at a minimum, for independent pixel errors of standard deviation `sigma_px` per axis.

    Where views have a pixel scale, that is of `sigma_px` times the scale. Held views and points have zeros, what is
    not determined (a point seen once) has nan.
    """

    of_views: Float[np.ndarray, "v 6 6"]
    """Of the right tangent (omega, v) of `Rigid3.retract`."""
    of_cameras: tuple[Float[np.ndarray, "_ _"], ...]
    """Per camera, of all its parameters; zeros for held ones."""
    of_points: Float[np.ndarray, "p 3 3"]
    gauge: str
    """"held": fixed views or points hold all seven freedoms; "inner": see `bundle_covariance`."""


def bundle_covariance(
    problem: BundleProblem, options: BundleOptions | None = None, *, sigma_px: float = 1.0
) -> BundleCovariance:
    """Invert the normal equations of a bundle at its minimum.

    With S the reduced camera system: cov(c) = sigma^2 S^-1, cov(p) = sigma^2 (V^-1 + V^-1 W^T S^-1 W V^-1).
    Where nothing is fixed, S has seven free directions and S^-1 is its pseudo-inverse in the tangents about the
    median point, scaled so that the scene's median distance from that point counts as 1: the poses and cameras then
    have the least variance, and points follow them. With at least two views held, or one view and one point, the
    gauge counts as held.

    Raises:
        ValueError: The reduced system has more than 12,000 columns, or is singular in a held gauge.

    Source:
        `triggs2000`, section 9; `hartley2004`, section 5.2 and appendix 6.3.
    """
    options = options or BundleOptions()
    layout = lay_out(problem, in_front(problem))
    columns = layout.num_columns + layout.num_border
    if columns > MAX_COLUMNS:
        raise ValueError(f"covariance inverts a dense matrix of {columns} columns; {MAX_COLUMNS} are allowed")
    values = start_values(problem, layout)
    seen = layout.point_start[1:] > layout.point_start[:-1]
    pivot = np.median(values.points[seen], axis=0)
    pattern, workers = tile_pattern(layout, None), Workers(None, 1)
    work, at = allocate(layout, pattern), allocate_linearization(layout)
    linearize(layout, values, (LOSS_NUMBERS[options.loss], options.loss_scale_px**2), at, workers)
    system = camera_system(layout, values, pivot, at, work, workers)
    add_priors(prior_rows(problem, layout, options.camera_priors), values.params, system)
    reduced = reduce_system(layout, pattern, values, pivot, at, system, 0.0, work, workers)
    S = _dense(layout, pattern.given_index, work.tiles, reduced.border, reduced.corner)

    num_fixed_views, num_fixed_points = int(problem.fixed_views.sum()), int(problem.fixed_points.sum())
    held = num_fixed_views >= 2 or num_fixed_points >= 3 or (num_fixed_views >= 1 and num_fixed_points >= 1)
    length = float(np.median(np.linalg.norm(values.points[seen] - pivot, axis=1)))
    S_inv = sigma_px**2 * (_inverse(S) if held else _inner_inverse(S, layout, length))

    of_views = np.zeros((problem.num_views, 6, 6))
    turn_about_origin = np.eye(6)
    turn_about_origin[3:, :3] = skew(pivot)  # v at the origin = v at the pivot + pivot x omega
    for i, v in enumerate(layout.listed_view[: layout.num_slots]):
        first = i * layout.block
        of_views[v] = turn_about_origin @ S_inv[first : first + 6, first : first + 6] @ turn_about_origin.T
    return BundleCovariance(
        of_views,
        _cameras(problem, layout, S_inv),
        _points(problem, layout, values.points - pivot, at, work, S_inv, sigma_px),
        "held" if held else "inner",
    )


def _dense(layout: BundleLayout, index, tiles, border, corner) -> Float[np.ndarray, "n n"]:
    """The reduced camera system as one symmetric matrix, views first, then the border."""
    s, b, n = layout.num_slots, layout.block, layout.num_border
    count, per_tile = len(index), tiles.shape[1]
    size = per_tile * b
    views = np.zeros((count * size, count * size))
    for i, j in zip(*np.nonzero(index >= 0), strict=True):
        tile = tiles[index[i, j]].transpose(0, 2, 1, 3).reshape(size, size)
        views[i * size : (i + 1) * size, j * size : (j + 1) * size] = np.tril(tile) if i == j else tile
    S = np.zeros((s * b + n, s * b + n))
    S[: s * b, : s * b] = views[: s * b, : s * b]
    S[s * b :, : s * b] = border.reshape(n, s * b)
    S[s * b :, s * b :] = np.tril(corner)
    return np.tril(S) + np.tril(S, -1).T


def _inverse(S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Inverse of a positive definite matrix, scaled to a unit diagonal first."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    scaled = S * scale[:, None] * scale
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        raise ValueError("the bundle is not determined: a free view or parameter lacks observations") from None
    return np.linalg.inv(scaled) * scale[:, None] * scale


def _inner_inverse(S: Float[np.ndarray, "n n"], layout: BundleLayout, length: float) -> Float[np.ndarray, "n n"]:
    """Pseudo-inverse without the seven smallest eigenvalues, translations measured in units of `length`.

    Intrinsics are eliminated first, because the gauge does not touch them.
    """
    pose = np.zeros(len(S), dtype=bool)
    unit = np.ones(len(S))
    for i in range(layout.num_slots):
        pose[i * layout.block : i * layout.block + 6] = True
        unit[i * layout.block + 3 : i * layout.block + 6] = length
    A, C, D = S[np.ix_(pose, pose)], S[np.ix_(~pose, pose)], S[np.ix_(~pose, ~pose)]
    D_inv = _inverse(D) if len(D) else D
    scale = unit[pose]
    reduced = (A - C.T @ D_inv @ C) * scale[:, None] * scale
    eigenvalues, vectors = np.linalg.eigh(reduced)
    kept = vectors[:, GAUGE_FREEDOMS:]
    A_inv = (kept / eigenvalues[GAUGE_FREEDOMS:]) @ kept.T * scale[:, None] * scale
    coupling = -D_inv @ C
    out = np.empty_like(S)
    out[np.ix_(pose, pose)] = A_inv
    out[np.ix_(~pose, pose)] = coupling @ A_inv
    out[np.ix_(pose, ~pose)] = (coupling @ A_inv).T
    out[np.ix_(~pose, ~pose)] = D_inv + coupling @ A_inv @ coupling.T
    return out


def _cameras(
    problem: BundleProblem, layout: BundleLayout, S_inv: Float[np.ndarray, "n n"]
) -> tuple[Float[np.ndarray, "_ _"], ...]:
    """Blocks of the cameras, in the order of their parameters."""
    slot_of_camera = {int(layout.camera_of_view[v]): i for i, v in enumerate(layout.listed_view[: layout.num_slots])}
    out = []
    for c, camera in enumerate(problem.cameras):
        block = np.zeros((len(camera.params), len(camera.params)))
        active = layout.active[c, : layout.num_active[c]]
        if layout.own[c] or layout.border_of_camera[c] >= 0:
            first = (
                slot_of_camera[c] * layout.block + 6
                if layout.own[c]
                else layout.num_columns + int(layout.border_of_camera[c])
            )
            block[np.ix_(active, active)] = S_inv[first : first + len(active), first : first + len(active)]
        out.append(block)
    return tuple(out)


def _points(
    problem: BundleProblem, layout: BundleLayout, offsets: Float[np.ndarray, "p 3"], at: Linearization,
    work: Workspace, S_inv: Float[np.ndarray, "n n"], sigma_px: float,
) -> Float[np.ndarray, "p 3 3"]:  # fmt: skip
    """V^-1 + L^-T Z S^-1 Z^T L^-1 of every free point."""
    out = np.zeros((len(offsets), 3, 3))
    for p in np.flatnonzero(layout.free_point):
        a0, a1, a2, a3, a4, a5 = work.L_inv[p]
        L_inv = np.array([[a0, 0.0, 0.0], [a1, a2, 0.0], [a3, a4, a5]])
        if not a0 * a2 * a5 > 0 or np.linalg.cond(L_inv) > 1e8:
            out[layout.point_order[p]] = np.nan
            continue
        Z, columns = [], []
        for o in range(layout.point_start[p], layout.point_start[p + 1]):
            if layout.slot[o] >= 0:
                h = work.Z[o]
                Z.append(np.concatenate([np.cross(offsets[p], h[:, :3]), h], axis=1))
                columns.append(layout.slot[o] * layout.block + np.arange(layout.block))
        for e in range(layout.entry_start[p], layout.entry_start[p + 1]):
            c = layout.entry_camera[e]
            count = int(layout.num_active[c])
            Z.append(work.Z_border[e, :, :count])
            columns.append(layout.num_columns + layout.border_of_camera[c] + np.arange(count))
        inner = sigma_px**2 * np.eye(3)
        if Z:
            Z_p, at_columns = np.concatenate(Z, axis=1), np.concatenate(columns)
            inner = inner + Z_p @ S_inv[np.ix_(at_columns, at_columns)] @ Z_p.T
        out[layout.point_order[p]] = L_inv.T @ inner @ L_inv
    return out
