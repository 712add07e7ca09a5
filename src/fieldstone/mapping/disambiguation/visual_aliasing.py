"""Scenes that repeat themselves: pairs that match falsely with perfect geometry are found and taken out.

Around a building whose sides look alike, pairs of photos contradict each other: rotations along closed cycles do not
multiply to the identity. Where no strong pair contradicts the others, nothing is done. Otherwise the photos are spanned
by the pairs in which fewest correspondences are missing, and pairs that contradict this forest are taken out. It is cut
where its evidence is no better than that of pairs which contradict it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.disambiguation.missing_correspondences import find_missing_correspondences
from fieldstone.mapping.disambiguation.options import DisambiguationOptions, ForestOptions
from fieldstone.mapping.disambiguation.photo_order import forest_in_order
from fieldstone.mapping.disambiguation.rotation_forest import (
    Evidence,
    Pairs,
    RotationForest,
    least_missing_forest,
    maximum_spanning_forest,
    misses_less,
    rotation_angles,
)
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.solve.robust.two_view import degenerate

logger = logging.getLogger(__name__)

WHAT_WOULD_HELP = (
    "photos that also show what is around, or names in the order in which the photos were taken, would join them"
)


@dataclass(frozen=True, eq=False)
class Disambiguation:
    """The graph without false pairs, and what to tell of it."""

    graph: MatchGraph
    notes: tuple[str, ...]
    left_out: Int[np.ndarray, "n"]
    """Pairs of every photo that were taken out."""


def disambiguate(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: DisambiguationOptions,
) -> Disambiguation:
    """The graph without the pairs that show different places which look alike; unchanged in an ordinary scene.

    What cannot be decided is not joined: the pairs between the parts are taken out, and a mapper makes several models.

    Source:
        `zach2010` (cycles of rotations that do not close), `heinly2014` (missing correspondences), `roberts2011`
        (false pairs must not outvote true ones). Departure: a forest with pooled evidence takes the place of their
        inference.
    """
    pairs = pairs_with_rotation(graph, options)
    nothing = Disambiguation(graph, (), np.zeros(graph.num_images, dtype=np.int64))
    if not len(pairs):
        return nothing
    count, strong = contradictions(pairs, maximum_spanning_forest(pairs, graph.num_images), options.forest)
    # Weak pairs matter only where strong ones leave photos apart, or if there is something to decide.
    joined = maximum_spanning_forest(pairs.only_strong(), graph.num_images).component
    wanted = {
        pairs.pair(k) for k in np.flatnonzero(pairs.strong | (joined[pairs.first] != joined[pairs.second])).tolist()
    }
    missing = find_missing_correspondences(graph, cameras, camera_of_image, options.missing, wanted)
    evidence = Evidence.of(pairs, missing, options.forest)
    forest, doubted = least_missing_forest(pairs, evidence, graph.num_images)
    same = _largest_same_turn(pairs, forest, options)
    if _too_many(count, strong, options):
        note = f"ambiguous scene: {count} of {strong} strong pairs contradict the others, places in it look alike"
    elif doubted:
        note = (
            "ambiguous scene: places in it look alike, for photos that seem to be near each other share less than "
            f"others that are further apart, such as {_names(graph, pairs, doubted)}"
        )
    elif same >= max(options.min_same_turn_pairs, options.min_same_turn_ratio * len(pairs)):
        note = f"ambiguous scene: {same} pairs contradict the others by the same turn, places in it look alike"
    else:
        return nothing
    missing = find_missing_correspondences(graph, cameras, camera_of_image, options.missing)
    evidence = Evidence.of(pairs, missing, options.forest)
    forest, doubted = least_missing_forest(pairs, evidence, graph.num_images)
    forest, undecided = _review(forest, pairs, evidence, options)
    forest, notes = _decided(graph, pairs, forest, [*undecided, *doubted], options)
    return _without_false_pairs(graph, pairs, forest, (note, *notes), options.forest)


def _decided(
    graph: MatchGraph, pairs: Pairs, forest: RotationForest, open_pairs: list[int], options: DisambiguationOptions
) -> tuple[RotationForest, list[str]]:
    """The forest that the order of the photos tells, if it tells one that differs; else cut where pairs are open."""
    order = forest_in_order(pairs, graph.num_images, options)
    agreeing = forest.agreeing(pairs, options.forest.agreement)
    if order is not None and (
        open_pairs or agreeing[order.against].any() or not agreeing[list(order.forest.edges)].all()
    ):
        note = "the photos alone do not tell the places apart; they were taken to be in the order of their names"
        return order.forest, [f"ambiguous scene: {note}, walking around it"]
    if open_pairs:
        return _cut(forest, pairs, open_pairs), [
            f"ambiguous scene: cut at {len(open_pairs)} places where nothing tells true pairs from false ones, such as "
            f"between {_names(graph, pairs, open_pairs)}: the parts are models of their own; {WHAT_WOULD_HELP}"
        ]
    return forest, []


def _without_false_pairs(
    graph: MatchGraph, pairs: Pairs, forest: RotationForest, notes: tuple[str, ...], options: ForestOptions
) -> Disambiguation:
    """The graph without the pairs that contradict the forest."""
    false = np.flatnonzero(~forest.agreeing(pairs, options.agreement))
    two_views, left_out = dict(graph.two_views), np.zeros(graph.num_images, dtype=np.int64)
    for k in false.tolist():
        two_views[pairs.pair(k)] = degenerate(len(graph.matches[pairs.pair(k)]))
        left_out[list(pairs.pair(k))] += 1
    notes = (*notes, f"ambiguous scene: {len(false)} of {len(pairs)} pairs were taken to be false and left out")
    for note in notes:
        logger.warning("%s", note)
    return Disambiguation(graph.with_two_views(two_views), notes, left_out)


def _names(graph: MatchGraph, pairs: Pairs, rows: Sequence[int]) -> str:
    """The photos of the first few pairs."""
    return "; ".join(" and ".join(graph.names[v] for v in pairs.pair(k)) for k in rows[:3])


def _largest_same_turn(pairs: Pairs, forest: RotationForest, options: DisambiguationOptions) -> int:
    """Size of the largest group of pairs that contradict their tree by the same turn, one way or the other."""
    inside = forest.component[pairs.first] == forest.component[pairs.second]
    against = np.flatnonzero(inside & ~forest.agreeing(pairs, options.forest.agreement))
    turns = forest.cycle_rotations(pairs, against)
    turns = turns[rotation_angles(turns) > np.deg2rad(options.min_side_turn_deg)]
    best = 0
    limit = options.forest.agreement
    for turn in turns:
        alike = (rotation_angles(turns @ turn.T) < limit) | (rotation_angles(turns @ turn) < limit)
        best = max(best, int(alike.sum()))
    return best


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


def contradictions(pairs: Pairs, forest: RotationForest, options: ForestOptions) -> tuple[int, int]:
    """How many strong pairs contradict the trees they lie in, of how many."""
    inside = pairs.strong & (forest.component[pairs.first] == forest.component[pairs.second])
    return int((inside & ~forest.agreeing(pairs, options.agreement)).sum()), int(inside.sum())


def with_disambiguation(run: MappingRun, found: Disambiguation, options: DisambiguationOptions) -> MappingRun:
    """The run with what is to be told of ambiguous places, in its notes and in the verdicts on photos left outside.

    A finished model that contradicts many strong pairs is told of as well: it may show several places as one.
    """
    notes = list(found.notes)
    models, pairs = (run.reconstruction, *run.others), pairs_with_rotation(run.graph, options)
    for k, model in enumerate(models):
        count, strong = contradictions(pairs, _as_forest(model), options.forest)
        if _too_many(count, strong, options):
            notes.append(
                f"ambiguous scene: model {k + 1} of {len(models)} contradicts {count} of {strong} strong pairs, it may "
                "show several places as one"
            )
    verdicts = dict(run.verdicts)
    for name, count in zip(run.graph.names, found.left_out.tolist(), strict=True):
        if count and not verdicts[name].startswith("registered"):
            verdicts[name] += f"; {count} of its pairs were left out, because places look alike (see the notes)"
    return replace(run, notes=(*notes, *run.notes), verdicts=verdicts)


def _as_forest(model: Reconstruction) -> RotationForest:
    """A model as one tree; photos that are not registered are alone."""
    registered = np.zeros(len(model.views), dtype=bool)
    registered[model.registered()] = True
    rotations = [np.eye(3) if view.cam_from_world is None else view.cam_from_world.R for view in model.views]
    component = np.where(registered, len(registered), np.arange(len(registered)))
    return RotationForest(np.array(rotations).reshape(-1, 3, 3), component)


def _too_many(count: int, strong: int, options: DisambiguationOptions) -> bool:
    """Whether so many contradictions cannot be accidents."""
    return count >= max(options.min_contradicting_pairs, options.min_contradicting_ratio * strong)


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
