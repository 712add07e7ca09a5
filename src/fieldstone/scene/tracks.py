"""Tracks: which keypoints of which photos show one point of the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from fieldstone.scene.match_graph import MatchGraph


@dataclass(frozen=True, eq=False)
class Observations:
    """Row k: keypoint `keypoint[k]` of view `view[k]`, at `pixels[k]`, shows point `point[k]`; sorted by point."""

    view: Int[np.ndarray, "o"]
    keypoint: Int[np.ndarray, "o"]
    point: Int[np.ndarray, "o"]
    pixels: Float[np.ndarray, "o 2"]

    def __post_init__(self) -> None:
        if np.any(np.diff(self.point) < 0):
            raise ValueError("observations must be sorted by point")

    def __len__(self) -> int:
        return len(self.view)

    @staticmethod
    def empty() -> Observations:
        """No observation."""
        none = np.empty(0, dtype=np.int64)
        return Observations(none, none, none, np.empty((0, 2)))

    def select(self, keep: Bool[np.ndarray, "o"]) -> Observations:
        """The observations of a mask, point numbers unchanged."""
        return Observations(self.view[keep], self.keypoint[keep], self.point[keep], self.pixels[keep])


@dataclass(frozen=True, eq=False)
class TrackStatistics:
    """What became of the matches while tracks were built."""

    num_tracks: int
    num_observations: int
    dropped_conflicting: int
    """Tracks with two keypoints of one photo that are not the same place: they cannot be one point."""
    merged_duplicates: int
    """Keypoints dropped because their photo shows the track at the same place already."""


def build_tracks(graph: MatchGraph, *, max_duplicate_distance_px: float = 1.0) -> tuple[Observations, TrackStatistics]:
    """Tracks as connected components of the inlier matches, at most one keypoint per photo, at least two photos.

    A track that holds several keypoints of one photo is kept, with the first of them, when they lie within
    `max_duplicate_distance_px` of each other (features are repeated), and is dropped otherwise. Tracks are numbered
    by their first keypoint (photo, then index), so the result does not depend on the order of the pairs.
    """
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in graph.keypoints])]).astype(np.int64)
    total = int(offsets[-1])
    edges = [
        np.stack([offsets[i] + rows[:, 0], offsets[j] + rows[:, 1]], axis=1)
        for (i, j) in sorted(graph.matches)
        if len(rows := graph.inlier_matches((i, j)))
    ]
    if not edges:
        return Observations.empty(), TrackStatistics(0, 0, 0, 0)
    a, b = np.concatenate(edges).T
    adjacency = coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(total, total))
    _, label = connected_components(adjacency, directed=False)

    used = np.unique(np.concatenate([a, b]))
    view = np.repeat(np.arange(graph.num_images), np.diff(offsets))[used]
    keypoint = used - offsets[view]
    pixels = np.concatenate([k for k in graph.keypoints if len(k)])[used]
    track = _number_by_first_member(label[used])

    order = np.lexsort((keypoint, view, track))
    track, view, keypoint, pixels = track[order], view[order], keypoint[order], pixels[order]
    repeated = np.concatenate([[False], (np.diff(track) == 0) & (np.diff(view) == 0)])
    group_start = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(track))))
    apart = np.linalg.norm(pixels - pixels[group_start], axis=1) > max_duplicate_distance_px
    conflicting = np.zeros(int(track.max()) + 1, dtype=bool)
    conflicting[track[apart]] = True

    num_views = np.bincount(track[~repeated], minlength=len(conflicting))
    kept_track = ~conflicting & (num_views >= 2)
    keep = ~repeated & kept_track[track]
    renumber = np.cumsum(kept_track) - 1
    observations = Observations(view[keep], keypoint[keep], renumber[track[keep]], pixels[keep])
    statistics = TrackStatistics(
        num_tracks=int(kept_track.sum()),
        num_observations=int(keep.sum()),
        dropped_conflicting=int(conflicting.sum()),
        merged_duplicates=int((repeated & kept_track[track]).sum()),
    )
    return observations, statistics


def visibility_matrix(observations: Observations, num_views: int, num_points: int) -> csr_matrix:
    """Sparse boolean (num_views, num_points): entry (i, j) says that view i sees point j."""
    entries = np.ones(len(observations), dtype=bool)
    return csr_matrix((entries, (observations.view, observations.point)), shape=(num_views, num_points))


def compact_points(observations: Observations, keep: Bool[np.ndarray, "p"]) -> Observations:
    """Drop the observations of points outside the mask and renumber the others 0..keep.sum()-1."""
    kept = observations.select(keep[observations.point])
    renumber = np.cumsum(keep) - 1
    return Observations(kept.view, kept.keypoint, renumber[kept.point], kept.pixels)


def _number_by_first_member(label: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Component labels renumbered by first appearance."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]
