"""Absolute rotations from relative ones, robust to false edges."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu

from fieldstone.geometry.rotation import exp, log, nearest_rotation

L1_ITERATIONS = 10
IRLS_ITERATIONS = 20
SCALE = np.deg2rad(5.0)
"""Geman-McClure's scale: edges that are off by much more hardly count."""
SMALLEST_ANGLE = 1e-3
"""Angles below this, in radians, weigh no more in the L1 iterations."""
SETTLED = 1e-8


def average_rotations(
    pairs: Int[np.ndarray, "e 2"], Rj_from_Ri: Float[np.ndarray, "e 3 3"], weights: Float[np.ndarray, "e"]
) -> Float[np.ndarray, "v 3 3"]:
    """Rotations R_v with R_j = Rj_from_Ri R_i on as many edges as possible; the graph must be connected.

    Starts from the spanning tree of the edges that most triangles confirm, then minimises the weighted sum of angles
    (L1), then of Geman-McClure's function of the angles, each by reweighted least squares on the tangent space: a
    sparse Laplacian, the same for the three axes.

    Args:
        pairs: Views (i, j); every view 0..v-1 occurs.
        weights: Trust in each edge, for instance its number of inliers.

    Returns:
        World to view, the first view's rotation being the identity.

    Raises:
        ValueError: The graph is not connected.

    Source:
        `chatterjee2018`.
    """
    num_views = int(pairs.max()) + 1
    graph = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num_views, num_views))
    if connected_components(graph, directed=False)[0] != 1:
        raise ValueError("rotations can be averaged over a connected graph only")
    confirmed = triangle_support(pairs, Rj_from_Ri)
    weights = weights * confirmed
    R = _along_tree(pairs, Rj_from_Ri, confirmed + 1e-3 * weights / weights.max(), num_views)
    for iteration in range(L1_ITERATIONS + IRLS_ITERATIONS):
        residual = residual_rotations(pairs, Rj_from_Ri, R)
        angle = np.linalg.norm(residual, axis=1)
        if iteration < L1_ITERATIONS:
            robust = 1.0 / np.maximum(angle, SMALLEST_ANGLE)
        else:
            robust = (SCALE**2 / (SCALE**2 + angle**2)) ** 2
        step = _solve(pairs, residual, weights * robust, num_views)
        R = nearest_rotation(R @ exp(step))
        if iteration >= L1_ITERATIONS and np.abs(step).max(initial=0.0) < SETTLED:
            break
    return R @ R[0].T


def residual_rotations(
    pairs: Int[np.ndarray, "e 2"], Rj_from_Ri: Float[np.ndarray, "e 3 3"], R: Float[np.ndarray, "v 3 3"]
) -> Float[np.ndarray, "e 3"]:
    """Axis times angle, in the world, of R_j^T Rj_from_Ri R_i: zero where an edge agrees."""
    return log(np.swapaxes(R[pairs[:, 1]], -1, -2) @ Rj_from_Ri @ R[pairs[:, 0]])


def triangle_support(pairs: Int[np.ndarray, "e 2"], Rj_from_Ri: Float[np.ndarray, "e 3 3"]) -> Float[np.ndarray, "e"]:
    """How much of the triangles through each edge close, in (0, 1): those that close plus one, of all plus two."""
    edge = {(int(i), int(j)): e for e, (i, j) in enumerate(np.sort(pairs, axis=1))}
    forward = np.where((pairs[:, 0] < pairs[:, 1])[:, None, None], Rj_from_Ri, np.swapaxes(Rj_from_Ri, -1, -2))
    later: dict[int, set[int]] = {}
    for i, j in edge:
        later.setdefault(i, set()).add(j)
    triangles = np.array(
        [
            (ij, edge[j, k], edge[i, k])
            for (i, j), ij in edge.items()
            for k in sorted(later.get(i, set()) & later.get(j, set()))
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    around = np.swapaxes(forward[triangles[:, 2]], -1, -2) @ forward[triangles[:, 1]] @ forward[triangles[:, 0]]
    closes = np.linalg.norm(log(around), axis=1) < SCALE
    total = np.bincount(triangles.ravel(), minlength=len(pairs))
    good = np.bincount(triangles[closes].ravel(), minlength=len(pairs))
    return (good + 1.0) / (total + 2.0)


def _along_tree(
    pairs: Int[np.ndarray, "e 2"],
    Rj_from_Ri: Float[np.ndarray, "e 3 3"],
    weights: Float[np.ndarray, "e"],
    num_views: int,
) -> Float[np.ndarray, "v 3 3"]:
    """Rotations chained along the maximum spanning tree from view 0."""
    cost = 1.0 + weights.max() - weights  # scipy takes a cost of 0 for no edge
    tree = minimum_spanning_tree(csr_matrix((cost, (pairs[:, 0], pairs[:, 1])), shape=(num_views, num_views)))
    order, before = breadth_first_order(tree, 0, directed=False)
    edge = {(int(i), int(j)): e for e, (i, j) in enumerate(pairs)}
    R = np.tile(np.eye(3), (num_views, 1, 1))
    for view in order[1:].tolist():
        parent = int(before[view])
        known = (parent, view) in edge
        relative = Rj_from_Ri[edge[parent, view]] if known else Rj_from_Ri[edge[view, parent]].T
        R[view] = relative @ R[parent]
    return R


def _solve(
    pairs: Int[np.ndarray, "e 2"],
    residual: Float[np.ndarray, "e 3"],
    weights: Float[np.ndarray, "e"],
    num_views: int,
) -> Float[np.ndarray, "v 3"]:
    """Tangents w of all views, w_0 = 0, that minimise sum weights |residual + w_i - w_j|^2."""
    e = np.arange(len(pairs))
    rows, columns = np.concatenate([e, e]), np.concatenate([pairs[:, 1], pairs[:, 0]])
    signs = np.concatenate([np.ones(len(e)), -np.ones(len(e))])
    B = coo_matrix((signs, (rows, columns)), shape=(len(e), num_views)).tocsc()[:, 1:]
    weighted = B.multiply(weights[:, None])
    step = np.zeros((num_views, 3))
    if num_views > 1:
        step[1:] = splu((B.T @ weighted).tocsc()).solve(np.asarray(weighted.T @ residual))
    return step
