from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.io.images.exif import ExifFacts
from fieldstone.io.images.photos import PhotoInfo
from fieldstone.mapping.automatic import AutomaticOptions, finish_all, place
from fieldstone.mapping.disambiguation.disambiguate import Disambiguation
from fieldstone.mapping.incremental.options import IncrementalOptions
from fieldstone.run.map_photos import recover
from fieldstone.run.matching.detection import DetectedPhoto
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.recovery import Rematcher, Unregistered
from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_reconstruction_near

LAST = 5
ONE_CAMERA = np.zeros(6, dtype=np.int64)
OPTIONS = MatchingOptions(threads=1)


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    options = SceneOptions(num_cameras=6, num_points=400, layout="arc", noise_px=0.3)
    return synthesize(options, np.random.default_rng(0))


def detected_photos(scene: SyntheticScene) -> list[DetectedPhoto]:
    """Features whose descriptors are those of the points that they show, with a little noise."""
    rng = np.random.default_rng(1)
    of_point = rng.integers(0, 90, size=(len(scene.truth.points), 128))
    observations = scene.truth.observations
    photos = []
    for v, keypoints in enumerate(scene.graph.keypoints):
        descriptors = rng.integers(0, 90, size=(len(keypoints), 128))
        mine = observations.view == v
        descriptors[observations.keypoint[mine]] = of_point[observations.point[mine]]
        noisy = np.clip(descriptors + rng.integers(-4, 5, size=descriptors.shape), 0, 255).astype(np.uint8)
        n = len(keypoints)
        features = Features(keypoints, np.ones(n), np.zeros(n), noisy, np.zeros((n, 3), dtype=np.uint8))
        info = PhotoInfo(Path(scene.graph.names[v]), 640, 480, 1, ExifFacts())
        photos.append(DetectedPhoto(scene.graph.names[v], info, features, str(v)))
    return photos


def without_last(scene: SyntheticScene) -> MatchGraph:
    graph = replace(scene.graph, matches={p: rows for p, rows in scene.graph.matches.items() if LAST not in p})
    return verify_pairs(graph, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)


def placed(scene: SyntheticScene, graph: MatchGraph) -> Disambiguation:
    return place(graph, scene.truth.cameras, ONE_CAMERA, np.zeros(1), AutomaticOptions(), 0)


def test_a_photo_whose_pairs_were_not_chosen_is_registered(scene):
    graph, cameras, options = without_last(scene), scene.truth.cameras, AutomaticOptions()
    before = placed(scene, graph)
    assert [sub_model.num_registered for sub_model in before.sub_models] == [5]
    rematcher = Rematcher(detected_photos(scene), ONE_CAMERA, OPTIONS, 0)
    after = recover(before, [rematcher.other_pairs], options.incremental, 0)
    run = finish_all(after, cameras, ONE_CAMERA, options)
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.2, relative_distance=0.005)
    assert run.verdicts[graph.names[LAST]].startswith("registered")


def test_epipolar_lines_bring_matches_that_the_ratio_test_lost(scene):
    """A few matches give the geometry; the rest is found again along the lines."""
    photos = detected_photos(scene)
    everything = scene.graph.matches[0, LAST]
    thinned = replace(scene.graph, matches={**scene.graph.matches, (0, LAST): everything[::5]})
    graph = verify_pairs(thinned, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)
    unregistered = Unregistered((LAST,), np.arange(6) != LAST, scene.truth.cameras)
    more = Rematcher(photos, ONE_CAMERA, OPTIONS, 0).along_epipolar_lines(graph, unregistered)
    assert more is not None
    found = {tuple(row) for row in more.inlier_matches((0, LAST)).tolist()}
    assert len(found & {tuple(row) for row in everything.tolist()}) > 0.9 * len(everything)


def test_a_stage_that_gains_nothing_changes_nothing(scene):
    graph = without_last(scene)
    before, asked = placed(scene, graph), []

    def same_graph(graph: MatchGraph, unregistered: Unregistered) -> MatchGraph:
        asked.append(unregistered)
        return graph

    after = recover(before, [same_graph, lambda graph, unregistered: None], IncrementalOptions(), 0)
    assert after.sub_models == before.sub_models
    assert after.graph is graph
    assert asked[0].photos == (LAST,)
    assert asked[0].registered.tolist() == [True] * LAST + [False]


def test_no_stage_is_asked_where_every_photo_is_registered(scene):
    graph = verify_pairs(scene.graph, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)

    def not_needed(graph: MatchGraph, unregistered: Unregistered) -> MatchGraph:
        raise AssertionError("every photo is registered")

    before = placed(scene, graph)
    after = recover(before, [not_needed], IncrementalOptions(), 0)
    assert (after.sub_models, after.graph) == (before.sub_models, graph)
    nothing = replace(before, sub_models=())
    assert recover(nothing, [not_needed], IncrementalOptions(), 0).sub_models == ()
