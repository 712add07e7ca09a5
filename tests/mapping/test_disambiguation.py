from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fieldstone.evaluate.reconstruction_metrics import pairwise_pose_errors_deg
from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic, place
from fieldstone.mapping.disambiguation.agreement import agreement_with_models, contradiction
from fieldstone.mapping.disambiguation.bridges import cut_denied_bridges
from fieldstone.mapping.disambiguation.disambiguate import Disambiguation
from fieldstone.mapping.disambiguation.missing_correspondences import find_missing_correspondences
from fieldstone.mapping.disambiguation.missing_in_model import find_missing_in_model
from fieldstone.mapping.disambiguation.options import AgreementOptions, DisambiguationOptions, MissingOptions
from fieldstone.mapping.disambiguation.proposals import pairs_with_rotation
from fieldstone.mapping.incremental.registration import contradicts_pairs
from fieldstone.mapping.model.working_model import WorkingModel, to_reconstruction
from fieldstone.scene.alignment import align
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Points, Reconstruction
from fieldstone.scene.tracks import Observations
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.repeated_structure import RepeatedScene
from fieldstone.synthetic.street import StreetOptions, synthesize_street
from fieldstone.synthetic.symmetric import SymmetricOptions, synthesize_symmetric


@cache
def ring(seed: int = 0, **options) -> tuple[RepeatedScene, MatchGraph]:
    scene = synthesize_symmetric(SymmetricOptions(points_per_side=300, **options), np.random.default_rng(seed))
    one_camera = np.zeros(scene.graph.num_images, dtype=np.int64)
    return scene, verify_pairs(scene.graph, scene.truth.cameras, one_camera, TwoViewOptions(), seed, 2)


DEFAULT = DisambiguationOptions()


def resolve(scene: RepeatedScene, graph: MatchGraph, options: DisambiguationOptions = DEFAULT) -> Disambiguation:
    one_camera, exact = np.zeros(graph.num_images, dtype=np.int64), np.zeros(1)
    return place(graph, scene.truth.cameras, one_camera, exact, AutomaticOptions(disambiguation=options), 0)


def map_ring(scene: RepeatedScene, graph: MatchGraph) -> MappingRun:
    one_camera = np.zeros(graph.num_images, dtype=np.int64)
    return map_automatic(graph, scene.truth.cameras, one_camera, np.zeros(1), AutomaticOptions(), 0)


def agreeing_pairs(graph: MatchGraph) -> set[tuple[int, int]]:
    return {pair for pair, two_view in graph.two_views.items() if two_view.inliers.any()}


def worst_errors_deg(scene: RepeatedScene, run: MappingRun) -> list[float]:
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
def test_little_that_is_unique_tells_the_sides_apart_without_any_order():
    scene, graph = ring(num_photos=32, unique_share=0.07, shuffled=True)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 32
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert "lie upon each other" in run.notes[0]


@pytest.mark.slow
def test_without_any_surroundings_the_order_of_the_photos_is_recommended_and_the_fold_is_kept():
    scene, graph = ring(unique_share=0.0)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 28
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert "order" in run.notes[0]
    assert [len(model.registered()) for model in run.alternative] == [28]
    assert pairwise_pose_errors_deg(run.alternative[0], scene.truth).max() > 90.0


@pytest.mark.slow
def test_without_surroundings_or_order_nothing_is_pretended():
    scene, graph = ring(unique_share=0.0, shuffled=True)
    run = map_ring(scene, graph)
    assert run.alternative
    assert "nothing tells true pairs from false ones" in run.notes[0]


EXACT_RING = {"unevenness": 0.0, "jitter_deg": 0.0}
OPEN_PATH = {"sweep_deg": 300.0}
ALIKE = {"max_view_change_deg": 180.0}
"""Sides that look the same from wherever they are seen: rotations of false pairs agree with each other."""


@pytest.mark.slow
@pytest.mark.parametrize("view", [{}, EXACT_RING, OPEN_PATH])
def test_sides_that_are_alike_from_everywhere_are_not_folded(view):
    scene, graph = ring(unique_share=0.05, **ALIKE, **view)
    run = map_ring(scene, graph)
    assert sum(len(model.registered()) for model in (run.reconstruction, *run.others)) >= 26
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert run.notes[0].startswith("ambiguous scene")


@pytest.mark.slow
@pytest.mark.parametrize("unique_share", [0.1, 0.3])
def test_surroundings_tell_sides_apart_that_are_alike_from_everywhere(unique_share):
    scene, graph = ring(unique_share=unique_share, shuffled=True, **ALIKE)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 28
    assert max(worst_errors_deg(scene, run)) < 1.0
    assert run.notes[0].startswith("ambiguous scene")


@pytest.mark.slow
@pytest.mark.parametrize("shuffled", [True, False])
def test_a_fold_that_nothing_tells_is_reported_and_another_model_kept(shuffled):
    scene, graph = ring(unique_share=0.0, shuffled=shuffled, **ALIKE)
    run = map_ring(scene, graph)
    assert run.notes[0].startswith("ambiguous scene")
    assert run.alternative


@pytest.mark.parametrize("shuffled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_object_with_front_and_back_alike_is_not_folded(shuffled):
    scene, graph = ring(looks=(0, 1, 0, 2), unique_share=0.2, shuffled=shuffled)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 28
    assert worst_errors_deg(scene, run) == [pytest.approx(0.0, abs=1.0)]
    assert run.notes[0].startswith("ambiguous scene")


@cache
def street(**options) -> tuple[RepeatedScene, MatchGraph]:
    scene = synthesize_street(StreetOptions(**options), np.random.default_rng(0))
    one_camera = np.zeros(scene.graph.num_images, dtype=np.int64)
    return scene, verify_pairs(scene.graph, scene.truth.cameras, one_camera, TwoViewOptions(), 0, 2)


@pytest.mark.parametrize("unique_share", [0.15, pytest.param(0.3, marks=pytest.mark.slow)])
def test_equal_houses_stand_side_by_side(unique_share):
    """No rotation tells that they were laid upon each other: all look the same way."""
    scene, graph = street(unique_share=unique_share)
    run = map_ring(scene, graph)
    assert len(run.reconstruction.registered()) == 25
    assert align(run.reconstruction, scene.truth).position_error.max() < 0.1
    assert run.notes[0].startswith("ambiguous scene")


@pytest.mark.slow
def test_equal_houses_are_told_of_where_nothing_else_is_to_be_seen():
    scene, graph = street(unique_share=0.0)
    run = map_ring(scene, graph)
    assert align(run.reconstruction, scene.truth).position_error.max() < 0.1
    assert "nothing tells" in run.notes[0]
    assert align(run.alternative[0], scene.truth).position_error.max() > 1.0


def test_an_ordinary_street_is_left_alone():
    scene, graph = street(houses_differ=True)
    found = resolve(scene, graph)
    assert found.graph is graph
    assert found.notes == ()


def test_a_fold_contradicts_matches_and_lacks_what_is_of_one_place():
    """What decides, each on its own, on the fold and on the truth of the same matches."""
    scene, graph = ring(unique_share=0.1)
    options, missing = AgreementOptions(), MissingOptions()
    never = DisambiguationOptions(suspicion=1.0, min_denied=np.inf)
    folded = resolve(scene, graph, never).sub_models[0].model
    true = resolve(scene, graph).sub_models[0].model
    rates, contradicted = [], []
    for model in (folded, true):
        frozen = to_reconstruction(model, graph)
        rates.append(sum(m.missing for m in find_missing_in_model(frozen, missing).values()) / len(frozen.views))
        agreements = agreement_with_models(graph, [frozen], options)
        right = {pair for pair, a in agreements.items() if a.agrees(options) and scene.is_true(pair)}
        contradicted.append(contradiction(agreements.values(), options))
        if model is true:
            assert right == {pair for pair, a in agreements.items() if a.agrees(options)}
            assert all(a.contradicts(options) for pair, a in agreements.items() if not scene.is_true(pair))
    assert rates[0] > 5 * rates[1]
    assert contradicted[0] > 0.1  # and of the truth, every false pair: it is not the share alone that decides


def doubled(model: Reconstruction, common: int) -> Reconstruction:
    """Two places upon each other: every view twice, with points of its own but for the first `common` ones."""
    n, p, observations = len(model.views), len(model.points), model.observations
    second = np.where(observations.point < common, observations.point, observations.point + p)
    point = np.concatenate([observations.point, second])
    order = np.argsort(point, kind="stable")
    both = Observations(
        np.concatenate([observations.view, observations.view + n])[order],
        np.concatenate([observations.keypoint] * 2)[order],
        point[order],
        np.concatenate([observations.pixels] * 2)[order],
    )
    points = Points(np.tile(model.points.xyz, (2, 1)), np.tile(model.points.rgb, (2, 1)))
    again = tuple(replace(view, name=f"again_{view.name}") for view in model.views)
    return Reconstruction(model.cameras, (*model.views, *again), points, both)


def test_a_bridge_that_more_features_deny_than_hold_is_cut():
    scene, graph = ring(looks=(0, 1, 2, 3))
    model = map_ring(scene, graph).reconstruction
    n, options = len(model.views), DisambiguationOptions()
    for common, parts in ((5, 2), (len(model.points) // 2, 1)):
        twice = doubled(model, common)
        part, cut = cut_denied_bridges(twice, find_missing_in_model(twice, options.missing), options)
        assert len(np.unique(part)) == parts
        assert len(cut) == parts - 1
        assert len(np.unique(part[:n])) == 1
        assert len(np.unique(part[n:])) == 1
    _, cut = cut_denied_bridges(model, find_missing_in_model(model, options.missing), options)
    assert cut == []


def test_a_pose_that_the_photos_of_a_model_contradict_is_refused():
    scene, graph = ring(looks=(0, 1, 2, 3))
    empty = WorkingModel.start(scene.truth.cameras, np.zeros(28, dtype=np.int64), Observations.empty())
    model = empty.with_pose(3, scene.truth.pose_of(3)).with_pose(4, scene.truth.pose_of(4))
    assert contradicts_pairs(model, graph, 5, scene.truth.pose_of(5)) == ""
    turned = scene.truth.pose_of(5) @ Rigid3(exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    assert "ask for another pose" in contradicts_pairs(model, graph, 5, turned)
    assert "none of its photos" in contradicts_pairs(model, graph, 17, scene.truth.pose_of(17))


def test_a_pose_is_not_refused_for_rotations_that_the_matches_of_their_pairs_deny():
    """As of a plane, or of a focal length that was wrong: the pair's own pose is off, its matches are not."""
    scene, graph = ring(looks=(0, 1, 2, 3))
    empty = WorkingModel.start(scene.truth.cameras, np.zeros(28, dtype=np.int64), Observations.empty())
    model = empty.with_pose(3, scene.truth.pose_of(3)).with_pose(4, scene.truth.pose_of(4))
    turn = Rigid3(exp(np.array([0.0, 0.5, 0.0])), np.zeros(3))
    turned = {
        pair: replace(found, cam2_from_cam1=turn @ found.cam2_from_cam1)
        for pair, found in graph.two_views.items()
        if 5 in pair and found.cam2_from_cam1 is not None
    }
    turned = {**graph.two_views, **turned}
    assert contradicts_pairs(model, graph.with_two_views(turned), 5, scene.truth.pose_of(5)) == ""


def test_an_ordinary_ring_is_left_alone():
    scene, graph = ring(looks=(0, 1, 2, 3))
    found = resolve(scene, graph)
    assert found.graph is graph
    assert found.notes == ()
    assert not found.alternative


def test_an_ordinary_ring_loses_no_pair_even_if_it_is_suspected():
    suspicious = DisambiguationOptions(suspicion=-1.0)
    scene, graph = ring(looks=(0, 1, 2, 3))
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
