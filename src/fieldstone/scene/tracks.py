"""Tracks: which keypoints of which photos show one point of the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
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


def build_tracks(
    graph: MatchGraph, *, max_duplicate_distance_px: float = 1.0, split_conflicts: bool = False
) -> tuple[Observations, TrackStatistics]:
    """Tracks as connected components of the inlier matches, at most one keypoint per photo, at least two photos.

    A track that holds several keypoints of one photo is kept, with the first of them, when they lie within
    `max_duplicate_distance_px` of each other (features are repeated). Otherwise it is in conflict with itself, and is
    dropped; with `split_conflicts` it is built again, match by match from the pairs with most matches to those with
    fewest, leaving out every match that would join two places of one photo. Tracks are numbered by their first
    keypoint (photo, then index), so the result does not depend on the order of the pairs.
    """
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in graph.keypoints])]).astype(np.int64)
    edges = _edges(graph, offsets)
    if not len(edges):
        return Observations.empty(), TrackStatistics(0, 0, 0, 0)
    view = np.repeat(np.arange(graph.num_images), np.diff(offsets))
    pixels = np.concatenate([k for k in graph.keypoints if len(k)])
    scaled = pixels / graph.scale_of_image[view, None]
    label = _components(edges, int(offsets[-1]))
    used = np.unique(edges)
    conflicting = _conflicts(label, view, scaled, used, max_duplicate_distance_px)
    dropped = int(np.sum(conflicting))
    if split_conflicts and dropped:
        inside = conflicting[label[edges[:, 0]]]
        joined = _joinable(edges[inside], view, scaled, max_duplicate_distance_px)
        edges = np.concatenate([edges[~inside], edges[inside][joined]])
        label = _components(edges, int(offsets[-1]))
        used = np.unique(edges)
        conflicting = _conflicts(label, view, scaled, used, max_duplicate_distance_px)

    track = _number_by_first_member(label[used])
    order = np.lexsort((used, track))
    track, member = track[order], used[order]
    repeated = np.concatenate([[False], (np.diff(track) == 0) & (np.diff(view[member]) == 0)])
    num_views = np.bincount(track[~repeated])
    in_conflict = np.zeros(len(num_views), dtype=bool)
    in_conflict[track] = conflicting[label[member]]
    kept_track = ~in_conflict & (num_views >= 2)
    keep = ~repeated & kept_track[track]
    renumber = np.cumsum(kept_track) - 1
    kept = member[keep]
    observations = Observations(view[kept], kept - offsets[view[kept]], renumber[track[keep]], pixels[kept])
    return observations, TrackStatistics(
        num_tracks=int(kept_track.sum()),
        num_observations=len(kept),
        dropped_conflicting=0 if split_conflicts else dropped,
        merged_duplicates=int((repeated & kept_track[track]).sum()),
    )


def _edges(graph: MatchGraph, offsets: Int[np.ndarray, "_"]) -> Int[np.ndarray, "e 2"]:
    """Inlier matches as pairs of global keypoint numbers, the pairs of photos with most matches first."""
    rows = {pair: graph.inlier_matches(pair) for pair in sorted(graph.matches)}
    ordered = sorted(rows, key=lambda pair: (-len(rows[pair]), pair))
    parts = [rows[i, j] + np.array([offsets[i], offsets[j]]) for i, j in ordered]
    return np.concatenate(parts) if parts else np.empty((0, 2), dtype=np.int64)


def _components(edges: Int[np.ndarray, "e 2"], total: int) -> Int[np.ndarray, "total"]:
    """Component label of every keypoint."""
    adjacency = coo_matrix((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(total, total))
    return connected_components(adjacency, directed=False)[1].astype(np.int64)


def _conflicts(
    label: Int[np.ndarray, "total"],
    view: Int[np.ndarray, "total"],
    pixels: Float[np.ndarray, "total 2"],
    used: Int[np.ndarray, "u"],
    max_distance: float,
) -> Bool[np.ndarray, "labels"]:
    """Which components hold two different places of one photo."""
    order = used[np.lexsort((used, view[used], label[used]))]
    same = np.concatenate([[False], (np.diff(label[order]) == 0) & (np.diff(view[order]) == 0)])
    first = order[np.maximum.accumulate(np.where(same, 0, np.arange(len(order))))]
    apart = np.linalg.norm(pixels[order] - pixels[first], axis=1) > max_distance
    out = np.zeros(int(label.max()) + 1, dtype=bool)
    out[label[order[apart]]] = True
    return out


def _joinable(
    edges: Int[np.ndarray, "e 2"],
    view: Int[np.ndarray, "total"],
    pixels: Float[np.ndarray, "total 2"],
    max_distance: float,
) -> Bool[np.ndarray, "e"]:
    """Which matches, taken in order, join two tracks that show no photo at two places (union-find)."""
    parent: dict[int, int] = {}
    places: dict[int, dict[int, int]] = {}

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for node in np.unique(edges).tolist():
        parent[node] = node
        places[node] = {int(view[node]): node}
    out = np.zeros(len(edges), dtype=bool)
    for k, (a, b) in enumerate(edges.tolist()):
        small, large = sorted((root(a), root(b)), key=lambda r: len(places[r]))
        if small == large:
            out[k] = True
            continue
        shared = places[small].keys() & places[large].keys()
        if any(np.linalg.norm(pixels[places[small][v]] - pixels[places[large][v]]) > max_distance for v in shared):
            continue
        parent[small] = large
        places[large] = {**places.pop(small), **places[large]}
        out[k] = True
    return out


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
