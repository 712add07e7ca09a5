"""Positions of all cameras and points at once, from known rotations, as a linear problem."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_matrix, csc_matrix, identity
from scipy.sparse.linalg import splu

ROUNDS = 8
FIRST_SCALE = np.deg2rad(10.0)
LAST_SCALE = np.deg2rad(1.0)
"""Geman-McClure's scale of the angle between a ray and its point falls from the first to the last."""
NEAREST_SHARE = 0.05
"""Points nearer than this quantile of the distances weigh no more for being near."""
SHIFT = 1e-10
"""Share of the mean diagonal that keeps the factorisation away from zero pivots: exact data make a singular matrix."""


def position_views_and_points(
    view: Int[np.ndarray, "o"], point: Int[np.ndarray, "o"], rays: Float[np.ndarray, "o 3"]
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "p 3"]]:
    """Camera centres c and points X with X_p - c_v along the ray of every observation, up to a similarity.

    Minimises sum w |(I - d d^T)(X_p - c_v)|^2 while the depths d^T (X_p - c_v) are 1 in the mean: what is pulled
    together to one place has no depth. The points are eliminated, which leaves one sparse linear system with three
    columns per camera, and no start is needed. Rounds of weights turn distances to the rays into angles, and take
    false rays out.

    Args:
        view, point: Numbers without gaps; every point has two rays that are not parallel.
        rays: Unit directions in the world, from the camera to the point.

    Returns:
        Centres (the first is 0, the farthest is at distance 1) and points.

    Source:
        The objective of `jiang2013` with points instead of triplets; robust rounds after `pan2024`.
    """
    num_views, num_points = int(view.max()) + 1, int(point.max()) + 1
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    trust, distance = np.ones(len(rays)), np.ones(len(rays))
    centers, points = np.zeros((num_views, 3)), np.zeros((num_points, 3))
    for scale in np.geomspace(FIRST_SCALE, LAST_SCALE, ROUNDS):
        blocks = across * (trust / distance**2)[:, None, None]
        pulls = rays * (trust / distance)[:, None]
        centers, points = _stationary(view, point, blocks, pulls, num_views, num_points)
        offset = points[point] - centers[view]
        along = np.sum(offset * rays, axis=1)
        angle = np.arctan2(np.linalg.norm(offset - along[:, None] * rays, axis=1), along)
        trust = (scale**2 / (scale**2 + angle**2)) ** 2
        distance = np.linalg.norm(offset, axis=1)
        distance = np.maximum(distance, max(float(np.quantile(distance, NEAREST_SHARE)), 1e-300))
        distance /= np.median(distance)
    points, centers = points - centers[0], centers - centers[0]
    farthest = max(float(np.linalg.norm(centers, axis=1).max()), 1e-300)
    return centers / farthest, points / farthest


def _stationary(
    view: Int[np.ndarray, "o"],
    point: Int[np.ndarray, "o"],
    blocks: Float[np.ndarray, "o 3 3"],
    pulls: Float[np.ndarray, "o 3"],
    num_views: int,
    num_points: int,
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "p 3"]]:
    """Where the weighted cost pulls back as the constraint pulls the points away from the cameras, at any scale."""
    point_blocks = _sums(blocks, point, num_points)
    # A point whose rays are all but parallel is held by a little of its own trace.
    trace = np.trace(point_blocks, axis1=1, axis2=2)
    inverse = np.linalg.inv(point_blocks + (1e-12 * np.maximum(trace, 1e-300))[:, None, None] * np.eye(3))
    order = np.lexsort((view, point))
    starts = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=num_points))])
    shape = (3 * num_points, 3 * num_views)
    cross = bsr_matrix((blocks[order], view[order], starts), shape=shape).tocsr()
    inverse_cross = bsr_matrix((inverse[point[order]] @ blocks[order], view[order], starts), shape=shape).tocsr()
    diagonal = bsr_matrix((_sums(blocks, view, num_views), np.arange(num_views), np.arange(num_views + 1)))
    reduced = csc_matrix(diagonal.tocsr() - cross.T @ inverse_cross)
    shift = SHIFT * float(reduced.diagonal().sum()) / (3 * num_views)
    factor = splu((reduced + shift * identity(3 * num_views, format="csc")).tocsc())
    point_pulls = _sums(pulls, point, num_points)
    points_at_rest = np.einsum("pij,pj->pi", inverse, point_pulls)
    right = cross.T @ points_at_rest.ravel() - _sums(pulls, view, num_views).ravel()
    centers = factor.solve(right).reshape(-1, 3)
    centers -= centers.mean(axis=0)  # moving everything costs nothing
    points = points_at_rest + (inverse_cross @ centers.ravel()).reshape(-1, 3)
    size = max(float(np.linalg.norm(centers)), 1e-300)
    return centers / size, points / size


def _sums(values: Float[np.ndarray, "o *n"], index: Int[np.ndarray, "o"], count: int) -> Float[np.ndarray, "count *n"]:
    """The sum of the values of each index."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(index, weights=column, minlength=count) for column in flat.T], axis=1)
    return sums.reshape(count, *values.shape[1:])
