from functools import cache

import numpy as np
import pytest

from fieldstone.evaluate.reconstruction_metrics import pairwise_pose_errors_deg
from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.disambiguation.missing_correspondences import find_missing_correspondences
from fieldstone.mapping.disambiguation.options import DisambiguationOptions, MissingOptions
from fieldstone.mapping.disambiguation.rotation_forest import maximum_spanning_forest
from fieldstone.mapping.disambiguation.visual_aliasing import contradictions, disambiguate, pairs_with_rotation
from fieldstone.mapping.incremental.registration import contradicts_pairs
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import Observations
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.symmetric import SymmetricOptions, SymmetricScene, synthesize_symmetric


@cache
def ring(seed: int = 0, **options) -> tuple[SymmetricScene, MatchGraph]:
    scene = synthesize_symmetric(SymmetricOptions(points_per_side=300, **options), np.random.default_rng(seed))
    one_camera = np.zeros(scene.graph.num_images, dtype=np.int64)
    return scene, verify_pairs(scene.graph, scene.truth.cameras, one_camera, TwoViewOptions(), seed, 2)


DEFAULT = DisambiguationOptions()


def resolve(scene: SymmetricScene, graph: MatchGraph, options: DisambiguationOptions = DEFAULT):
    return disambiguate(graph, scene.truth.cameras, np.zeros(graph.num_images, dtype=np.int64), options)


def map_ring(scene: SymmetricScene, graph: MatchGraph) -> MappingRun:
    one_camera = np.zeros(graph.num_images, dtype=np.int64)
    return map_automatic(graph, scene.truth.cameras, one_camera, np.array([True]), AutomaticOptions(), 0)


def agreeing_pairs(graph: MatchGraph) -> set[tuple[int, int]]:
    return {pair for pair, two_view in graph.two_views.items() if two_view.inliers.any()}


def worst_errors_deg(scene: SymmetricScene, run: MappingRun) -> list[float]:
    """Largest relative pose error inside each model."""
    errors = [pairwise_pose_errors_deg(model, scene.truth) for model in (run.reconstruction, *run.others)]
    return [float(e[np.isfinite(e)].max(initial=0.0)) for e in errors]


def test_a_symmetric_building_with_surroundings_is_not_folded():
    scene, graph = ring(unique_share=0.1)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 28
    assert worst_errors_deg(scene, run) == [pytest.approx(0.0, abs=1.0)]
    assert run.notes[0].startswith("ambiguous scene")


@pytest.mark.slow
def test_what_cannot_be_decided_is_split_and_told_of():
    scene, graph = ring(num_photos=32, unique_share=0.07, shuffled=True)
    run = map_ring(scene, graph)
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert any("ambiguous scene" in note for note in run.notes)
    outside = [run.verdicts[view.name] for view in run.reconstruction.views if view.cam_from_world is None]
    assert all("places look alike" in verdict for verdict in outside)


def test_without_any_surroundings_the_order_of_the_photos_decides():
    scene, graph = ring(unique_share=0.0)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 28
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert "order" in run.notes[1]


@pytest.mark.slow
def test_without_surroundings_or_order_nothing_is_pretended():
    scene, graph = ring(unique_share=0.0, shuffled=True)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) < 28
    assert "nothing tells true pairs from false ones" in run.notes[1]


EXACT_RING = {"unevenness": 0.0, "jitter_deg": 0.0}
OPEN_PATH = {"sweep_deg": 300.0}
ALIKE = {"max_view_change_deg": 180.0}
"""Sides that look the same from wherever they are seen: rotations of false pairs agree with each other."""


@pytest.mark.parametrize("unique_share", [pytest.param(0.0, marks=pytest.mark.slow), 0.05])
@pytest.mark.parametrize("view", [{}, *(pytest.param(v, marks=pytest.mark.slow) for v in (EXACT_RING, OPEN_PATH))])
def test_sides_that_are_alike_from_everywhere_are_not_folded(unique_share, view):
    scene, graph = ring(unique_share=unique_share, **ALIKE, **view)
    run = map_ring(scene, graph)
    assert sum(len(model.registered()) for model in (run.reconstruction, *run.others)) >= 26
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert run.notes[0].startswith("ambiguous scene")


@pytest.mark.parametrize(("unique_share", "registered"), [(0.1, 20), pytest.param(0.3, 28, marks=pytest.mark.slow)])
def test_without_order_surroundings_split_sides_that_are_alike_from_everywhere(unique_share, registered):
    scene, graph = ring(unique_share=unique_share, shuffled=True, **ALIKE)
    run = map_ring(scene, graph)
    assert sum(len(model.registered()) for model in (run.reconstruction, *run.others)) >= registered
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert run.notes[0].startswith("ambiguous scene")


@pytest.mark.slow
def test_a_fold_that_nothing_tells_is_reported():
    scene, graph = ring(unique_share=0.0, shuffled=True, **ALIKE)
    run = map_ring(scene, graph)
    assert max(worst_errors_deg(scene, run)) > 90.0
    assert run.notes[0].startswith("ambiguous scene")


def test_a_pose_that_the_photos_of_a_model_contradict_is_refused():
    scene, graph = ring(sides_differ=True)
    empty = WorkingModel.start(scene.truth.cameras, np.zeros(28, dtype=np.int64), Observations.empty())
    model = empty.with_pose(3, scene.truth.pose_of(3)).with_pose(4, scene.truth.pose_of(4))
    assert contradicts_pairs(model, graph, 5, scene.truth.pose_of(5)) == ""
    turned = scene.truth.pose_of(5) @ Rigid3(exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    assert "ask for another rotation" in contradicts_pairs(model, graph, 5, turned)
    assert "none of its photos" in contradicts_pairs(model, graph, 17, scene.truth.pose_of(17))


def test_an_ordinary_ring_is_left_alone():
    scene, graph = ring(sides_differ=True)
    resolution = resolve(scene, graph)
    assert resolution.graph is graph
    assert resolution.notes == ()
    pairs = pairs_with_rotation(graph, DEFAULT)
    assert contradictions(pairs, maximum_spanning_forest(pairs, 28), DEFAULT.forest)[0] == 0


def test_an_ordinary_ring_loses_no_pair_even_if_it_is_suspected():
    suspicious = DisambiguationOptions(min_contradicting_pairs=0, min_contradicting_ratio=0.0)
    scene, graph = ring(sides_differ=True)
    strong = pairs_with_rotation(graph, DEFAULT)
    kept = agreeing_pairs(resolve(scene, graph, suspicious).graph)
    assert {strong.pair(k) for k in np.flatnonzero(strong.strong).tolist()} <= kept
    # Of the weakest pairs, seen from 40 degrees apart, a few have a wrong rotation of their own.
    wrong = agreeing_pairs(graph) - kept
    truth = scene.truth
    for i, j in wrong:
        pose = graph.two_views[i, j].cam2_from_cam1
        assert pose is not None
        assert np.rad2deg(angle_between(pose.R, truth.pose_of(j).R @ truth.pose_of(i).R.T)) > 5


@pytest.mark.slow
def test_a_result_does_not_depend_on_the_order_of_the_pairs():
    scene, graph = ring(unique_share=0.1)
    backwards = MatchGraph(graph.names, graph.keypoints, graph.colors, dict(reversed(list(graph.matches.items()))))
    backwards = backwards.with_two_views(dict(reversed(list(graph.two_views.items()))))
    assert agreeing_pairs(resolve(scene, backwards).graph) == agreeing_pairs(resolve(scene, graph).graph)


def test_false_pairs_miss_more_than_true_ones():
    scene, graph = ring(unique_share=0.1)
    found = find_missing_correspondences(graph, scene.truth.cameras, np.zeros(28, dtype=np.int64), MissingOptions())
    rates: dict[bool, list[float]] = {True: [], False: []}
    for pair, counts in found.items():
        if counts.angle < np.deg2rad(25) and counts.inliers > 100 and counts.expected > 0:
            rates[scene.is_true(pair)].append(counts.missing / counts.expected)
    assert max(np.quantile(rates[True], 0.9), 0.005) < np.quantile(rates[False], 0.1)


def test_false_pairs_have_a_perfect_geometry_of_a_turned_camera():
    """The oracle of the scene itself: a false pair agrees with the truth once a camera is moved to another side."""
    scene, graph = ring(unique_share=0.1)
    turns = exp(np.array([[0.0, 0.0, k * np.pi / 2] for k in range(4)]))
    count = 0
    for pair, two_view in graph.two_views.items():
        if two_view.inliers.sum() < 150 or two_view.kind != "calibrated":
            continue
        R1, R2 = (scene.truth.pose_of(view).R for view in pair)
        assert two_view.cam2_from_cam1 is not None
        errors = np.rad2deg(angle_between(R2 @ turns @ R1.T, np.tile(two_view.cam2_from_cam1.R, (4, 1, 1))))
        assert errors.min() < 1.0
        assert (np.argmin(errors) == 0) == scene.is_true(pair)
        count += 1
    assert count > 100
