"""Rotations of photos from trees of pairs, and which other pairs agree with them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import bdtr

from fieldstone.mapping.disambiguation.missing_correspondences import Conflict
from fieldstone.scene.match_graph import ImagePair

AGREE = float(np.deg2rad(15.0))
"""Pairs whose rotation differs by less from that of the tree agree with it: the drift along its branches."""
NARROW = float(np.deg2rad(10.0))
"""Only pairs whose rays meet at an angle up to this much above the smallest tell how much is missing."""
FEATURES_PER_REGION = 4
"""Features that are missing together count as one observation."""
SIGNIFICANCE, CLEAR_RATIO = 0.01, 2.0
"""How sure it is that one group of pairs misses less than another, and how much less."""
INVERSION_RATIO = 3.0
"""How much more than wider pairs next to them pairs have to miss for not being believed."""
MIN_DENSITY = 0.5
"""Share of the possible pairs between two trees that are there, at least, relative to that inside either."""
MISSING_FIELDS = ("missing", "expected")
STRONG, WEAK, DOUBTED = 0, 1, 2
"""Rungs of pairs."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of photos with a relative rotation, row k of every array for pair k."""

    first: Int[np.ndarray, "e"]
    second: Int[np.ndarray, "e"]
    cam2_R_cam1: Float[np.ndarray, "e 3 3"]
    inliers: Int[np.ndarray, "e"]
    strong: Bool[np.ndarray, "e"]
    """At least half as many inliers as the best pair of one of the two photos: what a tree is made of."""

    def __len__(self) -> int:
        return len(self.first)

    def pair(self, k: int) -> ImagePair:
        """The photos of a row."""
        return int(self.first[k]), int(self.second[k])

    def only_strong(self) -> Pairs:
        """The strong ones."""
        keep = self.strong
        return Pairs(self.first[keep], self.second[keep], self.cam2_R_cam1[keep], self.inliers[keep], keep[keep])


@dataclass(frozen=True, eq=False)
class Forest:
    """cam_R_root: rotation of every photo from the frame of its tree. root: number of its tree. tree: rows of pairs."""

    cam_R_root: Float[np.ndarray, "n 3 3"]
    root: Int[np.ndarray, "n"]
    tree: tuple[int, ...] = ()

    @staticmethod
    def bare(num_photos: int) -> Forest:
        """Every photo is a tree of its own."""
        return Forest(np.tile(np.eye(3), (num_photos, 1, 1)), np.arange(num_photos))

    def steps(self, pairs: Pairs, rows: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r 3 3"]:
        """What each pair says of the frame of its second photo's tree, seen from that of the first; identity agrees."""
        R1, R2 = self.cam_R_root[pairs.first[rows]], self.cam_R_root[pairs.second[rows]]
        return np.swapaxes(R2, 1, 2) @ pairs.cam2_R_cam1[rows] @ R1

    def turned(self, views: Bool[np.ndarray, "n"], new_R_old: Float[np.ndarray, "3 3"]) -> Forest:
        """The same with the frame of some photos replaced."""
        rotations = self.cam_R_root.copy()
        rotations[views] = rotations[views] @ new_R_old.T
        return replace(self, cam_R_root=rotations)

    def joined(self, pairs: Pairs, k: int) -> Forest:
        """The two trees of a pair as one."""
        a, b = self.root[pairs.first[k]], self.root[pairs.second[k]]
        root2_R_root1 = self.steps(pairs, np.array([k]))[0]
        moved = self.root == b
        out = self.turned(moved, root2_R_root1.T)
        return Forest(out.cam_R_root, np.where(moved, a, self.root), (*self.tree, k))

    def agreeing(self, pairs: Pairs) -> Bool[np.ndarray, "e"]:
        """Pairs inside one tree whose rotation is that of the tree."""
        inside = self.root[pairs.first] == self.root[pairs.second]
        return inside & (turn_angles(self.steps(pairs, np.arange(len(pairs)))) < AGREE)

    def side(self, pairs: Pairs, without: int) -> Bool[np.ndarray, "n"]:
        """The photos that still hang together with the second photo of a tree row when that row is cut."""
        label = np.arange(len(self.root))
        for k in self.tree:
            if k != without:
                label[label == label[pairs.second[k]]] = label[pairs.first[k]]
        return label == label[pairs.second[without]]


def turn_angles(R: Float[np.ndarray, "r 3 3"]) -> Float[np.ndarray, "r"]:
    """Angles of rotations, in radians: trace R = 1 + 2 cos angle."""
    return np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))


def tree_of_most_inliers(pairs: Pairs, num_photos: int) -> Forest:
    """The maximum spanning forest of the inlier counts (Kruskal)."""
    forest = Forest.bare(num_photos)
    for k in np.lexsort((pairs.second, pairs.first, -pairs.inliers)).tolist():
        if forest.root[pairs.first[k]] != forest.root[pairs.second[k]]:
            forest = forest.joined(pairs, k)
    return forest


@dataclass(frozen=True)
class Missing:
    """Sums over several pairs that say the same."""

    missing: int
    expected: int
    inliers: int

    def upper_rate(self) -> float:
        """Share that is missing, two standard errors up: little evidence is no good evidence."""
        return (self.missing + 2.0 + 2.0 * np.sqrt(self.missing + 1.0)) / max(self.expected, 1)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is missing in pairs, row k for pair k; see `conflicts.Conflict`."""

    missing: Int[np.ndarray, "e"]
    expected: Int[np.ndarray, "e"]
    angle: Float[np.ndarray, "e"]
    inliers: Int[np.ndarray, "e"]

    @staticmethod
    def of(pairs: Pairs, conflicts: Mapping[ImagePair, Conflict]) -> Evidence:
        """Nothing is expected of pairs without a conflict."""
        rows = [conflicts.get(pairs.pair(k), Conflict(0, 0, 0, 0.0)) for k in range(len(pairs))]
        missing, expected = (np.array([getattr(c, name) for c in rows], dtype=np.int64) for name in MISSING_FIELDS)
        return Evidence(missing, expected, np.array([c.angle for c in rows], dtype=np.float64), pairs.inliers)

    def narrow(self, rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "_"]:
        """The pairs of narrowest angle: views from further apart share less in any case."""
        return rows[self.angle[rows] <= self.angle[rows].min() + NARROW]

    def added(self, rows: Int[np.ndarray, "r"]) -> Missing:
        """Sums over pairs."""
        return Missing(*(int(column[rows].sum()) for column in (self.missing, self.expected, self.inliers)))

    def pooled(self, rows: Int[np.ndarray, "r"]) -> Missing:
        """What is missing in the narrowest of some pairs, and the inliers of all."""
        return replace(self.added(self.narrow(rows)), inliers=int(self.inliers[rows].sum()))


def misses_less(a: Missing, b: Missing, ratio: float = CLEAR_RATIO) -> bool:
    """Whether pairs `a` miss clearly less than pairs `b` (two Poisson rates, compared by their binomial law)."""
    missing_a, missing_b = a.missing / FEATURES_PER_REGION, b.missing / FEATURES_PER_REGION
    if ratio * (missing_a + 0.5) * b.expected >= missing_b * a.expected:
        return False
    together = math.ceil(missing_a + missing_b)
    chance = bdtr(math.floor(missing_a), together, a.expected / (a.expected + b.expected))
    return bool(chance < SIGNIFICANCE)


def tree_of_least_conflict(pairs: Pairs, evidence: Evidence, num_photos: int) -> tuple[Forest, tuple[int, ...]]:
    """Join photos and trees by the pairs in which least is missing; weak pairs only join what strong ones leave apart.

    A pair that would join two trees is judged together with all strong pairs between them that say the same. Pairs
    that miss clearly more than wider pairs inside either of the two trees join nothing: what one sees from afar, one
    sees from near by.

    Returns:
        The forest, and the strong pairs that were not believed: of every two trees that they would join, the first.
    """
    forest, doubted = Forest.bare(num_photos), []
    queue = [(*_rank(forest, pairs, evidence, k), k) for k in range(len(pairs))]
    heapq.heapify(queue)
    while queue:
        rung, rate, k = heapq.heappop(queue)
        if forest.root[pairs.first[k]] == forest.root[pairs.second[k]]:
            continue
        now = _rank(forest, pairs, evidence, k)
        if now > (rung, rate) and queue and (*now, k) > queue[0]:
            heapq.heappush(queue, (*now, k))
            continue
        if now[0] != DOUBTED:
            forest = forest.joined(pairs, k)
    between: set[tuple[int, int]] = set()
    for k in np.flatnonzero(pairs.strong).tolist():
        a, b = sorted((int(forest.root[pairs.first[k]]), int(forest.root[pairs.second[k]])))
        if a != b and (a, b) not in between:
            between.add((a, b))
            doubted.append(k)
    return forest, tuple(doubted)


def _rank(forest: Forest, pairs: Pairs, evidence: Evidence, k: int) -> tuple[int, float]:
    """Which pairs are to join trees first: of the lower rung, then those that miss least."""
    a, b = forest.root[pairs.first[k]], forest.root[pairs.second[k]]
    one, two = forest.root[pairs.first], forest.root[pairs.second]
    between = np.flatnonzero(((one == a) & (two == b)) | ((one == b) & (two == a)))
    steps = forest.steps(pairs, between)
    backward = forest.root[pairs.first[between]] == b
    steps[backward] = np.swapaxes(steps[backward], 1, 2)
    same = between[turn_angles(steps @ steps[between == k][0].T) < AGREE]
    strong = between[pairs.strong[between]]
    if not pairs.strong[k]:
        different = len(np.setdiff1d(strong, same)) > 0
        better = different and misses_less(evidence.pooled(same), evidence.pooled(strong))
        return WEAK if better or not len(strong) else DOUBTED, evidence.added(np.array([k])).upper_rate()
    rows = np.intersect1d(strong, same)
    pooled = evidence.pooled(rows)
    min_angle = np.median(evidence.angle[evidence.narrow(rows)])
    for tree in (a, b):
        inside = np.flatnonzero((one == tree) & (two == tree) & pairs.strong)
        size, other = np.sum(forest.root == tree), np.sum(forest.root == a + b - tree)
        # Places that are taken for one have as many pairs between them as each has inside.
        if not len(inside) or len(rows) * (size - 1) < MIN_DENSITY * len(inside) * other:
            return STRONG, pooled.upper_rate()
        wide = inside[evidence.angle[inside] >= min_angle]
        wide = wide[turn_angles(forest.steps(pairs, wide)) < AGREE]
        if not len(wide) or not misses_less(evidence.added(wide), pooled, INVERSION_RATIO):
            return STRONG, pooled.upper_rate()
    return DOUBTED, pooled.upper_rate()
