from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.mapping.incremental.mapper import map_incremental
from fieldstone.mapping.incremental.merging import merge_linked
from fieldstone.mapping.incremental.options import IncrementalOptions
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.mapping.model.working_model import to_reconstruction
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_reconstruction_near

HALF, LINKING, SEEN_BY_OTHERS = 4, 40, 11
"""Photos of each half; matches of the only pair that links them; how many of these other photos of the halves have too:
one fewer than the mapper asks for to place a photo."""
ONE_CAMERA = np.zeros(2 * HALF, dtype=np.int64)
OPTIONS = IncrementalOptions()


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    options = SceneOptions(num_cameras=2 * HALF, num_points=500, layout="arc", noise_px=0.3)
    return synthesize(options, np.random.default_rng(0))


def in_two_halves(scene: SyntheticScene, link: np.ndarray) -> MatchGraph:
    """The verified graph with one pair between the halves, and the matches of that pair."""
    a, b = HALF - 1, HALF
    alone = {a: set(link[SEEN_BY_OTHERS:, 0].tolist()), b: set(link[SEEN_BY_OTHERS:, 1].tolist())}
    matches = {}
    for (i, j), rows in scene.graph.matches.items():
        if (i < HALF) == (j < HALF):
            kept = [p not in alone.get(i, ()) and q not in alone.get(j, ()) for p, q in rows.tolist()]
            matches[i, j] = rows[np.array(kept)]
    matches[a, b] = link
    graph = replace(scene.graph, matches=matches)
    return verify_pairs(graph, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)


def halves(scene: SyntheticScene, graph: MatchGraph) -> list[SubModel]:
    found = map_incremental(graph, scene.truth.cameras, ONE_CAMERA, (None,), OPTIONS, 0)
    assert [s.num_registered for s in found] == [HALF, HALF]
    return found


def true_link(scene: SyntheticScene) -> np.ndarray:
    """Matches between the two photos at the border of the halves, spread over the scene."""
    rows = scene.graph.matches[HALF - 1, HALF]
    return rows[np.random.default_rng(0).choice(len(rows), LINKING, replace=False)]


def test_halves_that_one_pair_links_become_one(scene):
    graph = in_two_halves(scene, true_link(scene))
    (merged,) = merge_linked(halves(scene, graph), graph, OPTIONS, 0)
    # No other pair holds the halves together: forty matches with the noise of the scene do.
    assert_reconstruction_near(
        to_reconstruction(merged.model, graph), scene.truth, angle_deg=0.5, relative_distance=0.02
    )


def test_halves_whose_link_is_false_stay_two(scene):
    link = true_link(scene)
    rng = np.random.default_rng(1)
    shuffled = np.stack([link[:, 0], rng.permutation(link[:, 1])], axis=1)
    graph = in_two_halves(scene, shuffled)
    parts = halves(scene, graph)
    assert merge_linked(parts, graph, OPTIONS, 0) == parts


def test_halves_that_see_each_other_in_wrong_places_stay_two(scene):
    graph = in_two_halves(scene, true_link(scene))
    first, second = halves(scene, graph)
    seen = np.unique(first.model.tracks.point[first.model.tracks.view < HALF])
    xyz = second.model.xyz.copy()
    xyz[seen] *= np.random.default_rng(2).uniform(0.3, 3.0, size=(len(seen), 1))
    bent = replace(second, model=replace(second.model, xyz=xyz))
    assert len(merge_linked([first, second], graph, OPTIONS, 0)) == 1
    assert len(merge_linked([first, bent], graph, OPTIONS, 0)) == 2


def test_halves_that_see_each_other_in_two_places_stay_two(scene):
    """As along a row of equal houses: half of the points that are seen lie as if one half were a house further."""
    graph = in_two_halves(scene, true_link(scene))
    first, second = halves(scene, graph)
    seen = np.unique(first.model.tracks.point[first.model.tracks.view < HALF])
    seen = seen[second.model.is_point()[seen]]
    xyz = second.model.xyz.copy()
    xyz[seen[::2]] += xyz[seen].std(axis=0)
    elsewhere = replace(second, model=replace(second.model, xyz=xyz))
    assert len(merge_linked([first, elsewhere], graph, OPTIONS, 0)) == 2
