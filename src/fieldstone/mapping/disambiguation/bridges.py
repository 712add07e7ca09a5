"""Parts of a model that hang together by matches which more features deny than confirm.

A few matches of different places place one group of photos among those of another. Then photos of both stand near
each other and look at the same points, and share next to none of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from fieldstone.mapping.disambiguation.missing_in_model import MissingInModel
from fieldstone.mapping.disambiguation.options import DisambiguationOptions
from fieldstone.scene.match_graph import ImagePair
from fieldstone.scene.reconstruction import Reconstruction


@dataclass(frozen=True)
class Bridge:
    """What holds two parts of a model together, and what denies it; the pair of photos with most points in common."""

    pair: ImagePair
    held: int
    """Points in common of photos on both sides, counted for every such pair."""
    denied: float
    """Features missing between photos of both sides."""


def cut_denied_bridges(
    model: Reconstruction, missing: Mapping[ImagePair, MissingInModel], options: DisambiguationOptions
) -> tuple[Int[np.ndarray, "v"], list[Bridge]]:
    """The part of every view once all bridges are cut that more features deny than hold, and those bridges.

    The maximum spanning tree of the points in common has an edge across every bridge; the most denied is cut first.

    Source:
        `heinly2014`, section 4: cuts of a spanning tree, judged by what is missing across.
    """
    common = _points_in_common(model)
    tree = _maximum_spanning_tree(common)
    pairs = np.array(list(missing), dtype=np.int64).reshape(-1, 2)
    counts = np.array([found.missing for found in missing.values()])
    cut: list[Bridge] = []
    while True:
        bridges = [_bridge(k, tree, common, pairs, counts) for k in range(len(tree) if counts.sum() > 0.0 else 0)]
        denied = [b for b in bridges if b.denied >= options.min_denied and b.denied > b.held]
        if not denied:
            return _parts(tree, len(model.views)), cut
        worst = max(denied, key=lambda b: (b.denied / max(b.held, 1), b.pair))
        cut.append(worst)
        tree = [pair for pair in tree if pair != worst.pair]


def _points_in_common(model: Reconstruction) -> Int[np.ndarray, "v v"]:
    """Number of points that two views both observe; 0 on the diagonal."""
    observations = model.observations
    shape = len(model.views), len(model.points)
    rows = np.unique(np.stack([observations.view, observations.point]), axis=1)
    observes = coo_matrix((np.ones(rows.shape[1], dtype=np.int64), tuple(rows)), shape=shape).tocsr()
    common = (observes @ observes.T).toarray()
    np.fill_diagonal(common, 0)
    return common


def _maximum_spanning_tree(common: Int[np.ndarray, "v v"]) -> list[ImagePair]:
    costs = np.where(common > 0, 1.0 / np.maximum(common, 1), 0.0)
    rows, cols = minimum_spanning_tree(costs).nonzero()
    return sorted((min(a, b), max(a, b)) for a, b in zip(rows.tolist(), cols.tolist(), strict=True))


def _parts(tree: Sequence[ImagePair], num_views: int) -> Int[np.ndarray, "v"]:
    rows, cols = np.array(tree, dtype=np.int64).reshape(-1, 2).T
    return connected_components(coo_matrix((np.ones(len(rows)), (rows, cols)), shape=(num_views, num_views)))[1]


def _bridge(
    k: int,
    tree: Sequence[ImagePair],
    common: Int[np.ndarray, "v v"],
    pairs: Int[np.ndarray, "m 2"],
    counts: Float[np.ndarray, "m"],
) -> Bridge:
    """What holds and denies one edge of the tree.

    Args:
        pairs, counts: Photos that ought to share more than they do, and by how many features.
    """
    part = _parts([*tree[:k], *tree[k + 1 :]], len(common))
    one, other = (part == part[view] for view in tree[k])
    across = (one[pairs[:, 0]] & other[pairs[:, 1]]) | (one[pairs[:, 1]] & other[pairs[:, 0]])
    return Bridge(tree[k], int(common[np.ix_(one, other)].sum()), float(counts[across].sum()))
