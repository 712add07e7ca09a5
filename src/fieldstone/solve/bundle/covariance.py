"""How well an adjusted bundle is determined: covariances of poses, intrinsics and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.rotation import skew
from fieldstone.solve.bundle.adjustment import BundleOptions, in_front
from fieldstone.solve.bundle.buffers import ReducedSystem, SolverBuffers, Values, allocate_linearization, start_values
from fieldstone.solve.bundle.camera_prior import add_priors, prior_rows
from fieldstone.solve.bundle.layout import BundleLayout, free_view_of_camera, lay_out
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.schur_solver import camera_system, linearize, reduce_system, schur_solver
from fieldstone.solve.bundle.tile_pattern import tile_pattern
from fieldstone.solve.bundle.workers import Workers

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
    layout, values, buffers, S = reduced_normal_equations(problem, options or BundleOptions())
    num_fixed_views, num_fixed_points = int(problem.fixed_views.sum()), int(problem.fixed_points.sum())
    held = num_fixed_views >= 2 or num_fixed_points >= 3 or (num_fixed_views >= 1 and num_fixed_points >= 1)
    offsets, seen = values.points - layout.pivot, layout.point_start[1:] > layout.point_start[:-1]
    length = float(np.median(np.linalg.norm(offsets[seen], axis=1)))
    S_inv = sigma_px**2 * (inverse(S) if held else _inner_inverse(S, layout, length))
    return BundleCovariance(
        _views(problem, layout, S_inv),
        _cameras(problem, layout, S_inv),
        _points(layout, offsets, buffers, S_inv, sigma_px),
        "held" if held else "inner",
    )


def reduced_normal_equations(
    problem: BundleProblem, options: BundleOptions
) -> tuple[BundleLayout, Values, SolverBuffers, Float[np.ndarray, "n n"]]:
    """The reduced camera system S with the priors, as a dense matrix, and what the points need to follow.

    Raises:
        ValueError: It has more than 12,000 columns.
    """
    layout = lay_out(problem, in_front(problem))
    columns = layout.num_columns + layout.num_shared
    if columns > MAX_COLUMNS:
        raise ValueError(f"covariance inverts a dense matrix of {columns} columns; {MAX_COLUMNS} are allowed")
    values, at = start_values(problem, layout), allocate_linearization(layout)
    solver = schur_solver(layout, tile_pattern(layout, None), options.kernel_loss, Workers(None, 1))
    linearize(solver, values, at)
    system = camera_system(solver, values, at)
    add_priors(prior_rows(problem, layout, options.camera_priors), values.params, system)
    S = _dense(layout, solver.pattern.given_index, reduce_system(solver, values, at, system, 0.0))
    return layout, values, solver.buffers, S


def _dense(
    layout: BundleLayout, tile_index: Int[np.ndarray, "t t"], reduced: ReducedSystem
) -> Float[np.ndarray, "n n"]:
    """The reduced camera system as one symmetric matrix, free views first, then shared intrinsics."""
    s, b, n = layout.num_free_views, layout.block, layout.num_shared
    count, per_tile = len(tile_index), reduced.tiles.shape[1]
    size = per_tile * b
    views = np.zeros((count * size, count * size))
    for i, j in zip(*np.nonzero(tile_index >= 0), strict=True):
        tile = reduced.tiles[tile_index[i, j]].transpose(0, 2, 1, 3).reshape(size, size)
        views[i * size : (i + 1) * size, j * size : (j + 1) * size] = np.tril(tile) if i == j else tile
    S = np.zeros((s * b + n, s * b + n))
    S[: s * b, : s * b] = views[: s * b, : s * b]
    S[s * b :, : s * b] = reduced.border.reshape(n, s * b)
    S[s * b :, s * b :] = np.tril(reduced.corner)
    return np.tril(S) + np.tril(S, -1).T


def inverse(S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
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
    for i in range(layout.num_free_views):
        pose[i * layout.block : i * layout.block + 6] = True
        unit[i * layout.block + 3 : i * layout.block + 6] = length
    A, C, D = S[np.ix_(pose, pose)], S[np.ix_(~pose, pose)], S[np.ix_(~pose, ~pose)]
    D_inv = inverse(D) if len(D) else D
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


def _views(problem: BundleProblem, layout: BundleLayout, S_inv: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "v 6 6"]:
    """Blocks of the poses, turned about the origin instead of the pivot."""
    out = np.zeros((problem.num_views, 6, 6))
    turn_about_origin = np.eye(6)
    turn_about_origin[3:, :3] = skew(layout.pivot)  # v at the origin = v at the pivot + pivot x omega
    for i, v in enumerate(layout.view_order[: layout.num_free_views]):
        first = i * layout.block
        out[v] = turn_about_origin @ S_inv[first : first + 6, first : first + 6] @ turn_about_origin.T
    return out


def _cameras(
    problem: BundleProblem, layout: BundleLayout, S_inv: Float[np.ndarray, "n n"]
) -> tuple[Float[np.ndarray, "_ _"], ...]:
    """Blocks of the cameras, in the order of their parameters."""
    view_of_camera = free_view_of_camera(layout)
    out = []
    for c, camera in enumerate(problem.cameras):
        block = np.zeros((len(camera.params), len(camera.params)))
        refined = layout.refined[c, : layout.num_refined[c]]
        if layout.per_view[c] or layout.shared_row[c] >= 0:
            first = (
                view_of_camera[c] * layout.block + 6
                if layout.per_view[c]
                else layout.num_columns + int(layout.shared_row[c])
            )
            block[np.ix_(refined, refined)] = S_inv[first : first + len(refined), first : first + len(refined)]
        out.append(block)
    return tuple(out)


def _points(
    layout: BundleLayout,
    offsets: Float[np.ndarray, "p 3"],
    buffers: SolverBuffers,
    S_inv: Float[np.ndarray, "n n"],
    sigma_px: float,
) -> Float[np.ndarray, "p 3 3"]:
    """V^-1 + L^-T Z S^-1 Z^T L^-1 of every free point."""
    out = np.zeros((len(offsets), 3, 3))
    for p in np.flatnonzero(layout.free_point).tolist():
        a0, a1, a2, a3, a4, a5 = buffers.L_inv[p]
        L_inv = np.array([[a0, 0.0, 0.0], [a1, a2, 0.0], [a3, a4, a5]])
        if not a0 * a2 * a5 > 0 or np.linalg.cond(L_inv) > 1e8:
            out[layout.point_order[p]] = np.nan
            continue
        inner = sigma_px**2 * np.eye(3)
        Z, columns = _point_coupling(layout, offsets[p], buffers, p)
        if len(columns):
            inner = inner + Z @ S_inv[np.ix_(columns, columns)] @ Z.T
        out[layout.point_order[p]] = L_inv.T @ inner @ L_inv
    return out


def _point_coupling(
    layout: BundleLayout, offset: Float[np.ndarray, "3"], buffers: SolverBuffers, p: int
) -> tuple[Float[np.ndarray, "3 k"], Int[np.ndarray, "k"]]:
    """Z of one point, and the columns of the reduced system that it belongs to."""
    couplings = layout.couplings
    Z, columns = [np.empty((3, 0))], [np.empty(0, dtype=np.int64)]
    for o in range(layout.point_start[p], layout.point_start[p + 1]):
        if layout.free_index[o] >= 0:
            h = buffers.Z[o]
            Z.append(np.concatenate([np.cross(offset, h[:, :3]), h], axis=1))
            columns.append(layout.free_index[o] * layout.block + np.arange(layout.block))
    for e in range(couplings.start[p], couplings.start[p + 1]):
        c = couplings.camera[e]
        count = int(layout.num_refined[c])
        Z.append(buffers.Z_shared[e, :, :count])
        columns.append(layout.num_columns + layout.shared_row[c] + np.arange(count))
    return np.concatenate(Z, axis=1), np.concatenate(columns)
