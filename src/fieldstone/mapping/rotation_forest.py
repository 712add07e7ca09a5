"""Rotations of photos from trees of pairs, and which other pairs agree with them."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.mapping.conflicts import Conflict
from fieldstone.scene.match_graph import ImagePair

AGREE = float(np.deg2rad(15.0))
"""Pairs whose rotation differs by less from that of the tree agree with it: the drift along its branches."""
NARROW = float(np.deg2rad(10.0))
"""Only pairs whose rays meet at an angle up to this much above the smallest tell how much is missing."""


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


def pooled(pairs: Pairs, conflicts: Sequence[Conflict], rows: Int[np.ndarray, "r"]) -> Missing:
    """What is missing in the pairs of narrowest angle: views from further apart share less in any case."""
    angle = np.array([conflicts[k].angle for k in rows])
    narrow = rows[angle <= angle.min() + NARROW]
    return Missing(
        sum(conflicts[k].missing for k in narrow),
        sum(conflicts[k].expected for k in narrow),
        int(pairs.inliers[rows].sum()),
    )


def tree_of_least_conflict(pairs: Pairs, conflicts: Sequence[Conflict], num_photos: int) -> Forest:
    """Join photos and trees by the pairs in which least is missing; weak pairs only join what strong ones leave apart.

    A pair that would join two trees is judged together with all strong pairs between them that say the same.
    """
    forest = Forest.bare(num_photos)

    def rank(k: int) -> tuple[bool, float]:
        rows = np.array([k])
        if pairs.strong[k]:
            a, b = forest.root[pairs.first[k]], forest.root[pairs.second[k]]
            one, two = forest.root[pairs.first], forest.root[pairs.second]
            between = np.flatnonzero(pairs.strong & (((one == a) & (two == b)) | ((one == b) & (two == a))))
            steps = forest.steps(pairs, between)
            backward = forest.root[pairs.first[between]] == b
            steps[backward] = np.swapaxes(steps[backward], 1, 2)
            rows = between[turn_angles(steps @ steps[between == k][0].T) < AGREE]
        return not pairs.strong[k], pooled(pairs, conflicts, rows).upper_rate()

    queue = [(*rank(k), k) for k in range(len(pairs))]
    heapq.heapify(queue)
    while queue:
        weak, rate, k = heapq.heappop(queue)
        if forest.root[pairs.first[k]] == forest.root[pairs.second[k]]:
            continue
        now = rank(k)
        if now > (weak, rate) and queue and (*now, k) > queue[0]:
            heapq.heappush(queue, (*now, k))
            continue
        forest = forest.joined(pairs, k)
    return forest
