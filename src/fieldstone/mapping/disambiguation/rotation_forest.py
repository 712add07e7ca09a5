"""Rotation spanning forests: rotations of photos along trees of pairs, and which other pairs agree with them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import bdtr

from fieldstone.mapping.disambiguation.missing_correspondences import MissingCorrespondences
from fieldstone.mapping.disambiguation.options import ForestOptions
from fieldstone.scene.match_graph import ImagePair

STRONG, WEAK, DOUBTED = 0, 1, 2
"""Ranks of pairs: the first join trees before the second, the last join none."""


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


@dataclass(frozen=True, eq=False)
class RotationForest:
    """Trees of pairs that span the photos of each component."""

    cam_R_root: Float[np.ndarray, "n 3 3"]
    """Rotation of every photo from the root of its tree."""
    component: Int[np.ndarray, "n"]
    """Number of its tree."""
    edges: tuple[int, ...] = ()
    """Rows of the pairs that the trees are made of."""

    @staticmethod
    def bare(num_photos: int) -> RotationForest:
        """Every photo is a tree of its own."""
        return RotationForest(np.tile(np.eye(3), (num_photos, 1, 1)), np.arange(num_photos))

    def cycle_rotations(self, pairs: Pairs, rows: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r 3 3"]:
        """What each pair says of the frame of its second photo's tree, seen from that of the first; identity agrees."""
        R1, R2 = self.cam_R_root[pairs.first[rows]], self.cam_R_root[pairs.second[rows]]
        return np.swapaxes(R2, 1, 2) @ pairs.cam2_R_cam1[rows] @ R1

    def rotated(self, views: Bool[np.ndarray, "n"], new_R_old: Float[np.ndarray, "3 3"]) -> RotationForest:
        """The same with the frame of some photos replaced."""
        rotations = self.cam_R_root.copy()
        rotations[views] = rotations[views] @ new_R_old.T
        return replace(self, cam_R_root=rotations)

    def joined(self, pairs: Pairs, k: int) -> RotationForest:
        """The two trees of a pair as one."""
        a, b = self.component[pairs.first[k]], self.component[pairs.second[k]]
        root2_R_root1 = self.cycle_rotations(pairs, np.array([k]))[0]
        moved = self.component == b
        out = self.rotated(moved, root2_R_root1.T)
        return RotationForest(out.cam_R_root, np.where(moved, a, self.component), (*self.edges, k))

    def agreeing(self, pairs: Pairs, agreement: float) -> Bool[np.ndarray, "e"]:
        """Pairs inside one tree whose rotation is that of the tree, up to an angle in radians."""
        inside = self.component[pairs.first] == self.component[pairs.second]
        return inside & (rotation_angles(self.cycle_rotations(pairs, np.arange(len(pairs)))) < agreement)

    def beyond(self, pairs: Pairs, edge: int) -> Bool[np.ndarray, "n"]:
        """The photos that are still connected to the second photo of an edge when that edge is cut."""
        label = np.arange(len(self.component))
        for k in self.edges:
            if k != edge:
                label[label == label[pairs.second[k]]] = label[pairs.first[k]]
        return label == label[pairs.second[edge]]


def rotation_angles(R: Float[np.ndarray, "r 3 3"]) -> Float[np.ndarray, "r"]:
    """Angles of rotations, in radians: trace R = 1 + 2 cos angle."""
    return np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))


@dataclass(frozen=True)
class PooledEvidence:
    """Sums over several pairs that say the same."""

    missing: int
    expected: int
    inliers: int

    def upper_rate(self) -> float:
        """Share that is missing, two standard errors up: little evidence is no good evidence."""
        return (self.missing + 2.0 + 2.0 * np.sqrt(self.missing + 1.0)) / max(self.expected, 1)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is missing in pairs, row k for pair k; see `MissingCorrespondences`."""

    missing: Int[np.ndarray, "e"]
    expected: Int[np.ndarray, "e"]
    angle: Float[np.ndarray, "e"]
    inliers: Int[np.ndarray, "e"]
    options: ForestOptions

    @staticmethod
    def of(pairs: Pairs, found: Mapping[ImagePair, MissingCorrespondences], options: ForestOptions) -> Evidence:
        """Nothing is expected of pairs for which nothing was found."""
        nothing = MissingCorrespondences(0, 0, 0, 0.0)
        rows = [found.get(pairs.pair(k), nothing) for k in range(len(pairs))]
        missing, expected = (
            np.array([getattr(c, name) for c in rows], dtype=np.int64) for name in ("missing", "expected")
        )
        angle = np.array([c.angle for c in rows], dtype=np.float64)
        return Evidence(missing, expected, angle, pairs.inliers, options)

    def narrow(self, rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "_"]:
        """The pairs of narrowest angle: views from further apart share less in any case."""
        return rows[self.angle[rows] <= self.angle[rows].min() + np.deg2rad(self.options.narrow_deg)]

    def added(self, rows: Int[np.ndarray, "r"]) -> PooledEvidence:
        """Sums over pairs."""
        return PooledEvidence(*(int(column[rows].sum()) for column in (self.missing, self.expected, self.inliers)))

    def pooled(self, rows: Int[np.ndarray, "r"]) -> PooledEvidence:
        """What is missing in the narrowest of some pairs, and the inliers of all."""
        return replace(self.added(self.narrow(rows)), inliers=int(self.inliers[rows].sum()))


def misses_less(a: PooledEvidence, b: PooledEvidence, options: ForestOptions, ratio: float | None = None) -> bool:
    """Whether pairs `a` miss clearly less than pairs `b`.

    Args:
        ratio: By which factor; None: `clear_ratio`.
    """
    one, other = ((float(pooled.missing), float(pooled.expected)) for pooled in (a, b))
    return lower_rate(one, other, options, ratio)


def lower_rate(
    a: tuple[float, float], b: tuple[float, float], options: ForestOptions, ratio: float | None = None
) -> bool:
    """Whether the rate `a` is clearly lower than `b`: two Poisson rates, compared by their binomial law.

    Args:
        a, b: Features that are missing, and of how many.
        ratio: By which factor; None: `clear_ratio`.
    """
    ratio = options.clear_ratio if ratio is None else ratio
    missing_a, missing_b = a[0] / options.features_per_region, b[0] / options.features_per_region
    if a[1] <= 0 or ratio * (missing_a + 0.5) * b[1] >= missing_b * a[1]:
        return False
    together = math.ceil(missing_a + missing_b)
    chance = bdtr(math.floor(missing_a), together, a[1] / (a[1] + b[1]))
    return bool(chance < options.significance)


def least_missing_forest(pairs: Pairs, evidence: Evidence, num_photos: int) -> tuple[RotationForest, tuple[int, ...]]:
    """Join photos and trees by the pairs in which least is missing; weak pairs only join what strong ones leave apart.

    A pair that would join two trees is judged together with all strong pairs between them that say the same. Pairs
    that miss clearly more than wider pairs inside either of the two trees join nothing: what one sees from afar, one
    sees from near by.

    Returns:
        The forest, and the strong pairs that were not believed: of every two trees that they would join, the first.
    """
    forest, doubted = RotationForest.bare(num_photos), []
    queue = [(*_rank(forest, pairs, evidence, k), k) for k in range(len(pairs))]
    heapq.heapify(queue)
    while queue:
        rank, rate, k = heapq.heappop(queue)
        if forest.component[pairs.first[k]] == forest.component[pairs.second[k]]:
            continue
        now = _rank(forest, pairs, evidence, k)
        if now > (rank, rate) and queue and (*now, k) > queue[0]:
            heapq.heappush(queue, (*now, k))
            continue
        if now[0] != DOUBTED:
            forest = forest.joined(pairs, k)
    between: set[tuple[int, int]] = set()
    for k in np.flatnonzero(pairs.strong).tolist():
        a, b = sorted((int(forest.component[pairs.first[k]]), int(forest.component[pairs.second[k]])))
        if a != b and (a, b) not in between:
            between.add((a, b))
            doubted.append(k)
    return forest, tuple(doubted)


def _rank(forest: RotationForest, pairs: Pairs, evidence: Evidence, k: int) -> tuple[int, float]:
    """Which pairs are to join trees first: of the lower rank, then those that miss least."""
    options = evidence.options
    a, b = forest.component[pairs.first[k]], forest.component[pairs.second[k]]
    one, two = forest.component[pairs.first], forest.component[pairs.second]
    between = np.flatnonzero(((one == a) & (two == b)) | ((one == b) & (two == a)))
    steps = forest.cycle_rotations(pairs, between)
    backward = forest.component[pairs.first[between]] == b
    steps[backward] = np.swapaxes(steps[backward], 1, 2)
    same = between[rotation_angles(steps @ steps[between == k][0].T) < options.agreement]
    strong = between[pairs.strong[between]]
    if not pairs.strong[k]:
        different = len(np.setdiff1d(strong, same)) > 0
        better = different and misses_less(evidence.pooled(same), evidence.pooled(strong), options)
        return WEAK if better or not len(strong) else DOUBTED, evidence.added(np.array([k])).upper_rate()
    rows = np.intersect1d(strong, same)
    pooled = evidence.pooled(rows)
    min_angle = np.median(evidence.angle[evidence.narrow(rows)])
    for tree in (a, b):
        inside = np.flatnonzero((one == tree) & (two == tree) & pairs.strong)
        size, other = np.sum(forest.component == tree), np.sum(forest.component == a + b - tree)
        # Places that are taken for one have as many pairs between them as each has inside.
        if not len(inside) or len(rows) * (size - 1) < options.min_density * len(inside) * other:
            return STRONG, pooled.upper_rate()
        wide = inside[evidence.angle[inside] >= min_angle]
        wide = wide[rotation_angles(forest.cycle_rotations(pairs, wide)) < options.agreement]
        if not len(wide) or not misses_less(evidence.added(wide), pooled, options, options.inversion_ratio):
            return STRONG, pooled.upper_rate()
    return DOUBTED, pooled.upper_rate()
