"""Scenes that repeat themselves: pairs that match falsely with perfect geometry are found and taken out.

Around a building whose sides look alike, pairs of photos contradict each other: rotations along closed cycles do not
multiply to the identity. Where no strong pair contradicts the others, nothing is done. Otherwise trees of photos are
grown by the pairs in which fewest correspondences are missing, and pairs that contradict the trees are taken out.
Trees are cut where their evidence is no better than that of pairs which contradict them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rotation import exp, log
from fieldstone.mapping.disambiguation.missing_correspondences import find_conflicts
from fieldstone.mapping.disambiguation.rotation_forest import (
    AGREE,
    Evidence,
    Forest,
    Pairs,
    misses_less,
    tree_of_least_conflict,
    tree_of_most_inliers,
    turn_angles,
)
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.solve.robust.two_view import degenerate

logger = logging.getLogger(__name__)

MIN_STRONG_INLIERS = 30
"""Fewer agreeing matches can come about by chance."""
CONTRADICTING_SHARE, CONTRADICTING_PAIRS = 0.02, 4
"""Share and number of strong pairs that have to contradict the others before anything is done."""
MIN_GROUP = 2
"""A single pair may be wrong for many reasons; places that look alike give several that say the same."""
MIN_SAME, SAME_SHARE, MIN_SIDE = 4, 0.01, float(np.deg2rad(45.0))
"""So many pairs, and such a share of all, cannot contradict the trees by the same turn of such a size by accident,
however weak they are: it is that from one side of a building to another that looks like it."""
SAME_TURN_SHARE = 0.75
"""Share of the steps from photo to photo, in their order, that go on turning the same way: taken while walking."""
MIN_STEPS = 8
WHAT_WOULD_HELP = (
    "photos that also show what is around, or names in the order in which the photos were taken, would join them"
)
MIN_TURN, MAX_UNEVENNESS = float(np.deg2rad(2.0)), float(np.deg2rad(35.0))
"""Of the steps: how far they turn at least, and how far from their mean; false pairs turn by a side more or less."""
MAX_STEP = 3
"""Photos that lie so near in their order are joined by pairs that turn as the steps do."""


@dataclass(frozen=True, eq=False)
class Resolution:
    """The graph without false pairs, and what to tell of it."""

    graph: MatchGraph
    notes: tuple[str, ...]
    left_out: Int[np.ndarray, "n"]
    """Pairs of every photo that were taken out."""


def resolve_ambiguity(
    graph: MatchGraph, cameras: Sequence[Camera], camera_of_image: Int[np.ndarray, "n"]
) -> Resolution:
    """The graph without the pairs that show different places which look alike; unchanged in an ordinary scene.

    What cannot be decided is not joined: the pairs between the parts are taken out, and a mapper makes several models.

    Source:
        `zach2010` (cycles of rotations that do not close), `heinly2014` (missing correspondences), `roberts2011`
        (false pairs must not outvote true ones). Departure: a forest with pooled evidence takes the place of their
        inference.
    """
    pairs = pairs_with_rotation(graph)
    nothing = Resolution(graph, (), np.zeros(graph.num_images, dtype=np.int64))
    if not len(pairs):
        return nothing
    count, strong = contradictions(pairs, tree_of_most_inliers(pairs, graph.num_images))
    # Weak pairs matter only where strong ones leave photos apart, or if there is something to decide.
    joined = tree_of_most_inliers(pairs.only_strong(), graph.num_images).root
    wanted = {
        pairs.pair(k) for k in np.flatnonzero(pairs.strong | (joined[pairs.first] != joined[pairs.second])).tolist()
    }
    evidence = Evidence.of(pairs, find_conflicts(graph, cameras, camera_of_image, wanted))
    forest, doubted = tree_of_least_conflict(pairs, evidence, graph.num_images)
    same = _most_alike(pairs, forest)
    if _too_many(count, strong):
        note = f"ambiguous scene: {count} of {strong} strong pairs contradict the others, places in it look alike"
    elif doubted:
        note = (
            "ambiguous scene: places in it look alike, for photos that seem to be near each other share less than "
            f"others that are further apart, such as {_names(graph, pairs, doubted)}"
        )
    elif same >= max(MIN_SAME, SAME_SHARE * len(pairs)):
        note = f"ambiguous scene: {same} pairs contradict the others by the same turn, places in it look alike"
    else:
        return nothing
    evidence = Evidence.of(pairs, find_conflicts(graph, cameras, camera_of_image))
    forest, doubted = tree_of_least_conflict(pairs, evidence, graph.num_images)
    forest, undecided = _review(forest, pairs, evidence)
    forest, notes = _decided(graph, pairs, forest, [*undecided, *doubted])
    return _without_false_pairs(graph, pairs, forest, (note, *notes))


def _decided(graph: MatchGraph, pairs: Pairs, forest: Forest, open_pairs: list[int]) -> tuple[Forest, list[str]]:
    """The forest that the order of the photos tells, if it tells one that differs; else cut where pairs are open."""
    order = _in_order(pairs, graph.num_images)
    agreeing = forest.agreeing(pairs)
    if order is not None and (
        open_pairs or agreeing[order.against].any() or not agreeing[list(order.forest.tree)].all()
    ):
        note = "the photos alone do not tell the places apart; they were taken to be in the order of their names"
        return order.forest, [f"ambiguous scene: {note}, walking around it"]
    if open_pairs:
        return _cut(forest, pairs, open_pairs), [
            f"ambiguous scene: cut at {len(open_pairs)} places where nothing tells true pairs from false ones, such as "
            f"between {_names(graph, pairs, open_pairs)}: the parts are models of their own; {WHAT_WOULD_HELP}"
        ]
    return forest, []


def _without_false_pairs(graph: MatchGraph, pairs: Pairs, forest: Forest, notes: tuple[str, ...]) -> Resolution:
    """The graph without the pairs that contradict the forest."""
    false = np.flatnonzero(~forest.agreeing(pairs))
    two_views, left_out = dict(graph.two_views), np.zeros(graph.num_images, dtype=np.int64)
    for k in false.tolist():
        two_views[pairs.pair(k)] = degenerate(len(graph.matches[pairs.pair(k)]))
        left_out[list(pairs.pair(k))] += 1
    notes = (*notes, f"ambiguous scene: {len(false)} of {len(pairs)} pairs were taken to be false and left out")
    for note in notes:
        logger.warning("%s", note)
    return Resolution(graph.with_two_views(two_views), notes, left_out)


def _names(graph: MatchGraph, pairs: Pairs, rows: Sequence[int]) -> str:
    """The photos of the first few pairs."""
    return "; ".join(" and ".join(graph.names[v] for v in pairs.pair(k)) for k in rows[:3])


def _most_alike(pairs: Pairs, forest: Forest) -> int:
    """Size of the largest group of pairs that contradict their tree by the same turn, one way or the other."""
    inside = forest.root[pairs.first] == forest.root[pairs.second]
    against = np.flatnonzero(inside & ~forest.agreeing(pairs))
    steps = forest.steps(pairs, against)
    steps = steps[turn_angles(steps) > MIN_SIDE]
    best = 0
    for step in steps:
        alike = (turn_angles(steps @ step.T) < AGREE) | (turn_angles(steps @ step) < AGREE)
        best = max(best, int(alike.sum()))
    return best


def pairs_with_rotation(graph: MatchGraph) -> Pairs:
    """All pairs that have a relative pose."""
    posed = [(p, v, v.cam2_from_cam1) for p, v in sorted(graph.two_views.items()) if v.inliers.any()]
    posed = [(p, int(v.inliers.sum()), pose.R) for p, v, pose in posed if pose is not None]
    index = np.array([pair for pair, _, _ in posed], dtype=np.int64).reshape(-1, 2)
    inliers = np.array([count for _, count, _ in posed], dtype=np.int64)
    best = np.zeros(graph.num_images, dtype=np.int64)
    np.maximum.at(best, index.ravel(), np.repeat(inliers, 2))
    strong = (inliers >= MIN_STRONG_INLIERS) & (2 * inliers >= best[index].min(axis=1))
    rotations = np.array([R for _, _, R in posed]).reshape(-1, 3, 3)
    return Pairs(index[:, 0], index[:, 1], rotations, inliers, strong)


def contradictions(pairs: Pairs, forest: Forest) -> tuple[int, int]:
    """How many strong pairs contradict the trees they lie in, of how many."""
    inside = pairs.strong & (forest.root[pairs.first] == forest.root[pairs.second])
    return int((inside & ~forest.agreeing(pairs)).sum()), int(inside.sum())


def with_ambiguity(run: MappingRun, resolution: Resolution) -> MappingRun:
    """The run with what is to be told of ambiguous places, in its notes and in the verdicts on photos left outside.

    A finished model that contradicts many strong pairs is told of as well: it may show several places as one.
    """
    notes = list(resolution.notes)
    models = (run.reconstruction, *run.others)
    for k, model in enumerate(models):
        count, strong = contradictions(pairs_with_rotation(run.graph), _as_forest(model))
        if _too_many(count, strong):
            notes.append(
                f"ambiguous scene: model {k + 1} of {len(models)} contradicts {count} of {strong} strong pairs, it may "
                "show several places as one"
            )
    verdicts = dict(run.verdicts)
    for name, count in zip(run.graph.names, resolution.left_out.tolist(), strict=True):
        if count and not verdicts[name].startswith("registered"):
            verdicts[name] += f"; {count} of its pairs were left out, because places look alike (see the notes)"
    return replace(run, notes=(*notes, *run.notes), verdicts=verdicts)


def _as_forest(model: Reconstruction) -> Forest:
    """A model as one tree; photos that are not registered are alone."""
    registered = np.zeros(len(model.views), dtype=bool)
    registered[model.registered()] = True
    rotations = [np.eye(3) if view.cam_from_world is None else view.cam_from_world.R for view in model.views]
    root = np.where(registered, len(registered), np.arange(len(registered)))
    return Forest(np.array(rotations).reshape(-1, 3, 3), root)


def _too_many(count: int, strong: int) -> bool:
    """Whether so many contradictions cannot be accidents."""
    return count >= max(CONTRADICTING_PAIRS, CONTRADICTING_SHARE * strong)


def _review(forest: Forest, pairs: Pairs, evidence: Evidence) -> tuple[Forest, list[int]]:
    """Ask of every branch whether the pairs across it that contradict it have better evidence, and turn it if so.

    Returns:
        The forest, and the branches whose evidence is not clearly better than that against them.
    """
    turned, undecided = _review_once(forest, pairs, evidence)
    for _ in forest.tree:
        if turned is None:
            break
        forest = turned
        turned, undecided = _review_once(forest, pairs, evidence)
    return forest, undecided


def _review_once(forest: Forest, pairs: Pairs, evidence: Evidence) -> tuple[Forest | None, list[int]]:
    undecided = []
    steps = forest.steps(pairs, np.arange(len(pairs)))
    for branch in reversed(forest.tree):
        side = forest.side(pairs, branch)
        same_tree = forest.root[pairs.first] == forest.root[pairs.second]
        across = np.flatnonzero(same_tree & pairs.strong & (side[pairs.first] != side[pairs.second]))
        agree = across[turn_angles(steps[across]) < AGREE]
        if not len(agree):
            agree = np.array([branch])
        held = evidence.pooled(agree)
        for rows, new_R_old in _groups(np.setdiff1d(across, agree), pairs, side, steps):
            other = evidence.pooled(rows)
            if len(rows) < MIN_GROUP or 2 * other.inliers < held.inliers:
                continue
            if misses_less(other, held):
                return forest.turned(side, new_R_old), []
            if not misses_less(held, other):
                undecided.append(branch)
                break
    return None, undecided


def _groups(
    rows: Int[np.ndarray, "r"], pairs: Pairs, side: Bool[np.ndarray, "n"], steps: Float[np.ndarray, "e 3 3"]
) -> list[tuple[Int[np.ndarray, "_"], Float[np.ndarray, "3 3"]]]:
    """Pairs that say the same of how the photos of one side ought to be turned, the largest group first."""
    # A pair asks for cam2_R_root new_R_old^T = cam2_R_cam1 cam1_R_root, so new_R_old = step^T where photo 2 is turned.
    asked = np.swapaxes(steps[rows], 1, 2).copy()
    forward = side[pairs.second[rows]]
    asked[~forward] = np.swapaxes(asked[~forward], 1, 2)
    groups = []
    while len(rows):
        center = asked[np.argmax(pairs.inliers[rows])]
        near = turn_angles(asked @ center.T) < AGREE
        groups.append((rows[near], center))
        rows, asked = rows[~near], asked[~near]
    return groups


def _cut(forest: Forest, pairs: Pairs, branches: Sequence[int]) -> Forest:
    """The forest without some of its branches."""
    label = np.arange(len(forest.root))
    kept = tuple(k for k in forest.tree if k not in set(branches))
    for k in kept:
        label[label == label[pairs.second[k]]] = label[pairs.first[k]]
    return Forest(forest.cam_R_root, label, kept)


@dataclass(frozen=True, eq=False)
class _Order:
    """The forest of pairs that are near in the order of the photos, and the near pairs that turn quite differently."""

    forest: Forest
    against: Int[np.ndarray, "_"]


def _in_order(pairs: Pairs, num_photos: int) -> _Order | None:
    """What the order of the photos tells, if the steps from photo to photo turn the same way.

    Steps over a corner may be wrong or missing: pairs that skip a photo or two bridge them, if they turn as far.
    """
    apart = pairs.second - pairs.first
    steps = np.flatnonzero(apart == 1)
    if len(steps) < max(MIN_STEPS, SAME_TURN_SHARE * (num_photos - 1)):
        return None
    one = np.median(log(pairs.cam2_R_cam1[steps]), axis=0)
    off = turn_angles(pairs.cam2_R_cam1 @ np.swapaxes(exp(apart[:, None] * one), 1, 2))
    as_expected = off < np.clip(0.5 * apart * np.linalg.norm(one), AGREE, MAX_UNEVENNESS)
    if as_expected[steps].sum() < SAME_TURN_SHARE * (num_photos - 1) or np.linalg.norm(one) < MIN_TURN:
        return None
    forest = Forest.bare(num_photos)
    for k in np.lexsort((-pairs.inliers, apart)).tolist():
        if apart[k] <= MAX_STEP and as_expected[k] and forest.root[pairs.first[k]] != forest.root[pairs.second[k]]:
            forest = forest.joined(pairs, k)
    return _Order(forest, np.flatnonzero((apart <= MAX_STEP) & (off > MIN_SIDE)))
