from collections import defaultdict

import numpy as np
import pytest

from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import Observations, build_tracks, compact_points


def graph_of(keypoints: list[np.ndarray], matches: dict) -> MatchGraph:
    colors = tuple(np.zeros((len(k), 3), dtype=np.uint8) for k in keypoints)
    names = tuple(str(i) for i in range(len(keypoints)))
    rows = {pair: np.array(m, dtype=np.int64).reshape(-1, 2) for pair, m in matches.items()}
    return MatchGraph(names, tuple(keypoints), colors, rows)


def random_graph(seed: int, num_views: int = 5, num_keypoints: int = 40) -> MatchGraph:
    rng = np.random.default_rng(seed)
    keypoints = [rng.uniform(0, 500, size=(num_keypoints, 2)) for _ in range(num_views)]
    matches = {
        (i, j): np.unique(rng.integers(0, num_keypoints, size=(12, 2)), axis=0)
        for i in range(num_views)
        for j in range(i + 1, num_views)
    }
    return graph_of(keypoints, matches)


def brute_force_components(graph: MatchGraph) -> set[frozenset]:
    neighbours = defaultdict(set)
    for (i, j), rows in graph.matches.items():
        for a, b in rows.tolist():
            neighbours[i, a].add((j, b))
            neighbours[j, b].add((i, a))
    seen, out = set(), set()
    for node in neighbours:
        if node in seen:
            continue
        component, stack = set(), [node]
        while stack:
            current = stack.pop()
            if current not in component:
                component.add(current)
                stack += neighbours[current]
        seen |= component
        out.add(frozenset(component))
    return out


def as_sets(observations: Observations) -> set[frozenset]:
    tracks = defaultdict(set)
    for v, k, p in zip(observations.view, observations.keypoint, observations.point, strict=True):
        tracks[int(p)].add((int(v), int(k)))
    return {frozenset(t) for t in tracks.values()}


@pytest.mark.parametrize("seed", range(10))
def test_tracks_are_the_components_without_conflict(seed):
    graph = random_graph(seed)
    components = brute_force_components(graph)
    consistent = {c for c in components if len({v for v, _ in c}) == len(c)}
    observations, statistics = build_tracks(graph)
    assert as_sets(observations) == consistent
    assert statistics.dropped_conflicting == len(components) - len(consistent)


@pytest.mark.parametrize("seed", range(10))
def test_split_tracks_hold_no_conflict_and_lose_no_consistent_one(seed):
    graph = random_graph(seed)
    whole, split = as_sets(build_tracks(graph)[0]), as_sets(build_tracks(graph, split_conflicts=True)[0])
    assert whole <= split
    assert all(len({v for v, _ in track}) == len(track) >= 2 for track in split)
    # No two tracks that a match joins could be one without a conflict.
    of_node = {node: track for track in split for node in track}
    for (i, j), rows in graph.matches.items():
        for a, b in rows.tolist():
            left, right = of_node.get((i, a)), of_node.get((j, b))
            if left and right and left != right:
                assert {v for v, _ in left} & {v for v, _ in right}


def test_pairs_with_more_matches_win_a_conflict():
    points = np.arange(20.0).reshape(10, 2) * 10
    strong = [(k, k) for k in range(10)]
    graph = graph_of([points] * 3, {(0, 1): strong, (1, 2): strong, (0, 2): [(0, 1)]})
    assert as_sets(build_tracks(graph, split_conflicts=True)[0]) == {
        frozenset({(0, k), (1, k), (2, k)}) for k in range(10)
    }


def test_repeated_keypoints_at_one_place_are_merged():
    a = np.array([[10.0, 10.0], [10.2, 10.0]])
    b = np.array([[50.0, 50.0]])
    observations, statistics = build_tracks(graph_of([a, b], {(0, 1): [(0, 0), (1, 0)]}))
    assert as_sets(observations) == {frozenset({(0, 0), (1, 0)})}
    assert statistics.merged_duplicates == 1


def test_order_of_pairs_does_not_matter_and_numbering_follows_the_photos():
    graph = random_graph(3)
    reversed_graph = graph_of(list(graph.keypoints), dict(reversed(list(graph.matches.items()))))
    first, second = build_tracks(graph)[0], build_tracks(reversed_graph)[0]
    np.testing.assert_array_equal(first.keypoint, second.keypoint)
    starts = np.unique(first.point, return_index=True)[1]
    leading = first.view[starts] * 1000 + first.keypoint[starts]
    assert np.all(np.diff(leading) > 0)


def test_no_matches_give_no_tracks():
    assert len(build_tracks(graph_of([np.zeros((3, 2))] * 2, {}))[0]) == 0
    assert len(build_tracks(graph_of([np.zeros((3, 2))] * 2, {(0, 1): []}))[0]) == 0


def test_compaction():
    observations = build_tracks(random_graph(1))[0]
    num_points = int(observations.point[-1]) + 1
    keep = np.arange(num_points) % 2 == 1
    compacted = compact_points(observations, keep)
    assert as_sets(compacted) == {
        frozenset((int(v), int(k)) for v, k in zip(observations.view[m], observations.keypoint[m], strict=True))
        for m in (observations.point == p for p in np.flatnonzero(keep))
    }
