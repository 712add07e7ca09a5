"""What might be true where places look alike: sets of pairs to map a scene from, that leave the doubtful ones out.

None of them is believed for its own sake. Each is mapped, grows by what agrees with it, and has to explain the photos
better than all pairs together do; see `hypotheses`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.disambiguation.missing_correspondences import find_missing_correspondences
from fieldstone.mapping.disambiguation.options import DisambiguationOptions
from fieldstone.mapping.disambiguation.photo_order import forest_in_order, pairs_in_order
from fieldstone.mapping.disambiguation.rotation_forest import (
    Evidence,
    Pairs,
    RotationForest,
    least_missing_forest,
    misses_less,
    rotation_angles,
)
from fieldstone.scene.match_graph import ImagePair, MatchGraph


@dataclass(frozen=True)
class Proposal:
    """Pairs to begin with, and in words what they are."""

    pairs: frozenset[ImagePair]
    why: str


def propose(
    graph: MatchGraph, cameras: Sequence[Camera], camera_of_image: Int[np.ndarray, "n"], options: DisambiguationOptions
) -> list[Proposal]:
    """Pairs along the order of the photos; those that miss least; and those without what is open to doubt.

    Source:
        `heinly2014` (missing correspondences), `zach2010` (cycles of rotations), `roberts2011` (false pairs must not
        outvote true ones). Departure: a forest with pooled evidence takes the place of their inference, and proposes
        only.
    """
    pairs = pairs_with_rotation(graph, options)
    if not len(pairs):
        return []
    missing = find_missing_correspondences(graph, cameras, camera_of_image, options.missing)
    evidence = Evidence.of(pairs, missing, options.forest)
    forest, doubted = least_missing_forest(pairs, evidence, graph.num_images)
    reviewed, undecided = _review(forest, pairs, evidence, options)
    out = [Proposal(_pairs_of(pairs, forest.edges), "by the pairs in which least is missing")]
    ordered = forest_in_order(pairs, graph.num_images, options)
    steps = pairs_in_order(pairs, graph.num_images, options) if ordered is None else ordered.edges
    if steps:
        out.insert(0, Proposal(_pairs_of(pairs, steps), "in the order of the photos' names"))
    parts = _cut(reviewed, pairs, [*undecided, *doubted])
    agreeing = np.flatnonzero(parts.agreeing(pairs, options.forest.agreement))
    out.append(Proposal(_pairs_of(pairs, agreeing.tolist()), "in parts, without the pairs that are open to doubt"))
    return [proposal for k, proposal in enumerate(out) if proposal.pairs not in [p.pairs for p in out[:k]]]


def _pairs_of(pairs: Pairs, rows: Sequence[int]) -> frozenset[ImagePair]:
    return frozenset(pairs.pair(k) for k in rows)


def pairs_with_rotation(graph: MatchGraph, options: DisambiguationOptions) -> Pairs:
    """All pairs that have a relative pose."""
    posed = [(p, v, v.cam2_from_cam1) for p, v in sorted(graph.two_views.items()) if v.inliers.any()]
    posed = [(p, int(v.inliers.sum()), pose.R) for p, v, pose in posed if pose is not None]
    index = np.array([pair for pair, _, _ in posed], dtype=np.int64).reshape(-1, 2)
    inliers = np.array([count for _, count, _ in posed], dtype=np.int64)
    best = np.zeros(graph.num_images, dtype=np.int64)
    np.maximum.at(best, index.ravel(), np.repeat(inliers, 2))
    strong = (inliers >= options.min_strong_inliers) & (2 * inliers >= best[index].min(axis=1))
    rotations = np.array([R for _, _, R in posed]).reshape(-1, 3, 3)
    return Pairs(index[:, 0], index[:, 1], rotations, inliers, strong)


def _review(
    forest: RotationForest, pairs: Pairs, evidence: Evidence, options: DisambiguationOptions
) -> tuple[RotationForest, list[int]]:
    """Ask of every edge whether the pairs across it that contradict it have better evidence, and turn it if so.

    Returns:
        The forest, and the edges whose evidence is not clearly better than that against them.
    """
    turned, undecided = _review_once(forest, pairs, evidence, options)
    for _ in forest.edges:
        if turned is None:
            break
        forest = turned
        turned, undecided = _review_once(forest, pairs, evidence, options)
    return forest, undecided


def _review_once(
    forest: RotationForest, pairs: Pairs, evidence: Evidence, options: DisambiguationOptions
) -> tuple[RotationForest | None, list[int]]:
    """The forest with the first edge cut and turned that has better evidence against it (None: there is none), and the
    edges that nothing decides."""
    undecided = []
    turns = forest.cycle_rotations(pairs, np.arange(len(pairs)))
    for edge in reversed(forest.edges):
        beyond = forest.beyond(pairs, edge)
        same_tree = forest.component[pairs.first] == forest.component[pairs.second]
        across = np.flatnonzero(same_tree & pairs.strong & (beyond[pairs.first] != beyond[pairs.second]))
        agree = across[rotation_angles(turns[across]) < options.forest.agreement]
        if not len(agree):
            agree = np.array([edge])
        held = evidence.pooled(agree)
        for rows, new_R_old in _groups(np.setdiff1d(across, agree), pairs, beyond, turns, options.forest.agreement):
            other = evidence.pooled(rows)
            if len(rows) < options.min_group or 2 * other.inliers < held.inliers:
                continue
            if misses_less(other, held, options.forest):
                return forest.rotated(beyond, new_R_old), []
            if not misses_less(held, other, options.forest):
                undecided.append(edge)
                break
    return None, undecided


def _groups(
    rows: Int[np.ndarray, "r"],
    pairs: Pairs,
    beyond: Bool[np.ndarray, "n"],
    turns: Float[np.ndarray, "e 3 3"],
    agreement: float,
) -> list[tuple[Int[np.ndarray, "_"], Float[np.ndarray, "3 3"]]]:
    """Pairs that say the same of how the photos beyond an edge ought to be turned, the largest group first."""
    # A pair asks for cam2_R_root new_R_old^T = cam2_R_cam1 cam1_R_root, so new_R_old = turn^T where photo 2 is turned.
    asked = np.swapaxes(turns[rows], 1, 2).copy()
    forward = beyond[pairs.second[rows]]
    asked[~forward] = np.swapaxes(asked[~forward], 1, 2)
    groups = []
    while len(rows):
        center = asked[np.argmax(pairs.inliers[rows])]
        near = rotation_angles(asked @ center.T) < agreement
        groups.append((rows[near], center))
        rows, asked = rows[~near], asked[~near]
    return groups


def _cut(forest: RotationForest, pairs: Pairs, edges: Sequence[int]) -> RotationForest:
    """The forest without some of its edges."""
    label = np.arange(len(forest.component))
    kept = tuple(k for k in forest.edges if k not in set(edges))
    for k in kept:
        label[label == label[pairs.second[k]]] = label[pairs.first[k]]
    return RotationForest(forest.cam_R_root, label, kept)
