from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.io.images.exif import ExifFacts
from fieldstone.io.images.photos import PhotoInfo
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.incremental.recovery import Wanted
from fieldstone.run.matching.detection import SeenPhoto
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.recovery import SecondLook
from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_reconstruction_near

LOST = 5
ONE_CAMERA = np.zeros(6, dtype=np.int64)
OPTIONS = MatchingOptions(threads=1)


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    options = SceneOptions(num_cameras=6, num_points=400, layout="arc", noise_px=0.3)
    return synthesize(options, np.random.default_rng(0))


def seen_photos(scene: SyntheticScene) -> list[SeenPhoto]:
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
        photos.append(SeenPhoto(info, features, str(v)))
    return photos


def without_last(scene: SyntheticScene) -> MatchGraph:
    graph = replace(scene.graph, matches={p: rows for p, rows in scene.graph.matches.items() if LOST not in p})
    return verify_pairs(graph, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)


def test_a_photo_whose_pairs_were_not_chosen_is_found_again(scene):
    graph, known = without_last(scene), np.array([True])
    first = map_automatic(graph, scene.truth.cameras, ONE_CAMERA, known, AutomaticOptions(), 0)
    assert len(first.reconstruction.registered()) == 5
    look = SecondLook(seen_photos(scene), ONE_CAMERA, OPTIONS, 0)
    second = map_automatic(graph, scene.truth.cameras, ONE_CAMERA, known, AutomaticOptions(), 0, [look.other_pairs])
    assert_reconstruction_near(second.reconstruction, scene.truth, angle_deg=0.2, relative_distance=0.005)
    assert second.verdicts[graph.names[LOST]].startswith("registered")


def test_epipolar_lines_bring_matches_that_the_ratio_test_lost(scene):
    """A few matches give the geometry; the rest is found again along the lines."""
    photos = seen_photos(scene)
    everything = scene.graph.matches[0, LOST]
    thinned = replace(scene.graph, matches={**scene.graph.matches, (0, LOST): everything[::5]})
    graph = verify_pairs(thinned, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)
    wanted = Wanted((LOST,), np.arange(6) != LOST, scene.truth.cameras)
    more = SecondLook(photos, ONE_CAMERA, OPTIONS, 0).along_epipolar_lines(graph, wanted)
    assert more is not None
    found = {tuple(row) for row in more.inlier_matches((0, LOST)).tolist()}
    assert len(found & {tuple(row) for row in everything.tolist()}) > 0.9 * len(everything)


def test_an_attempt_that_gains_nothing_changes_nothing(scene):
    graph, known = without_last(scene), np.array([True])
    plain = map_automatic(graph, scene.truth.cameras, ONE_CAMERA, known, AutomaticOptions(), 0)
    tried = map_automatic(
        graph, scene.truth.cameras, ONE_CAMERA, known, AutomaticOptions(), 0, [lambda graph, wanted: graph]
    )
    np.testing.assert_array_equal(plain.reconstruction.points.xyz, tried.reconstruction.points.xyz)
