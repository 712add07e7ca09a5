"""The grade of models that are right, and of the same models made wrong on purpose."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.grading.focal_evidence import focal_evidence
from fieldstone.mapping.grading.grade import grade_run, pairs_to_ask
from fieldstone.mapping.grading.hold import hinges, weakly_held
from fieldstone.mapping.grading.options import GradingOptions, Limits
from fieldstone.mapping.grading.pair_evidence import evidence_of_pairs, jacobian, moved, sampson_px
from fieldstone.records.mapping import CameraCertainty, Grade
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from fieldstone.solve.robust.two_view import TwoViewOptions, degenerate
from fieldstone.synthetic.symmetric import SymmetricOptions, synthesize_symmetric

OPTIONS = GradingOptions()
FREE = np.array([False])
PHOTOS = 28


@cache
def ordinary_building() -> tuple[Reconstruction, MatchGraph]:
    """A model of an ordinary building, all around it, and the verified matches that it was made of."""
    options = SymmetricOptions(num_photos=PHOTOS, points_per_side=300, looks=(0, 1, 2, 3))
    scene = synthesize_symmetric(options, np.random.default_rng(0))
    one_camera = np.zeros(PHOTOS, dtype=np.int64)
    graph = verify_pairs(scene.graph, scene.truth.cameras, one_camera, TwoViewOptions(), 0, 2)
    run = map_automatic(graph, scene.truth.cameras, one_camera, np.zeros(1), AutomaticOptions(), 0)
    assert len(run.reconstruction.registered()) == PHOTOS
    return run.reconstruction, graph


def grade(model: Reconstruction, graph: MatchGraph, known=FREE, options=OPTIONS) -> Grade:
    return grade_run(run_of(model, graph), graph, np.repeat(known, len(model.cameras)), options, 0, 2)


def run_of(model: Reconstruction, graph: MatchGraph) -> MappingRun:
    return MappingRun(model, graph, None, (), (), None, {})


def with_poses(model: Reconstruction, poses: dict[int, Rigid3]) -> Reconstruction:
    views = tuple(replace(v, cam_from_world=poses.get(k, v.cam_from_world)) for k, v in enumerate(model.views))
    return replace(model, views=views)


def with_focal(model: Reconstruction, factors: Mapping[int, float]) -> Reconstruction:
    """Some views with a camera of their own, of another focal length."""
    cameras, views = list(model.cameras), list(model.views)
    for k, factor in factors.items():
        camera = model.camera_of(k)
        params = camera.params.copy()
        params[: camera.spec.num_focal] *= factor
        views[k] = replace(views[k], camera=len(cameras))
        cameras.append(replace(camera, params=params))
    return replace(model, cameras=tuple(cameras), views=tuple(views))


def test_a_right_model_is_good():
    model, graph = ordinary_building()
    found = grade(model, graph)
    assert (found.word, found.reasons) == ("good", ())
    assert found.pairs > 30
    assert found.matches_kept == pytest.approx(1.0, abs=0.02)
    assert found.error_added == pytest.approx(0.0, abs=0.1)
    assert (found.other_focal, found.contradicted, found.weakly_held) == ((), (), ())


def test_the_grade_is_the_same_for_any_number_of_threads():
    model, graph = ordinary_building()
    one, two = (grade_run(run_of(model, graph), graph, FREE, OPTIONS, 3, threads) for threads in (1, 2))
    assert one == two


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_wrong_focal_length_is_doubtful(factor):
    model, graph = ordinary_building()
    found = grade(with_focal(model, dict(enumerate([factor] * PHOTOS))), graph)
    assert found.word == "doubtful"
    assert any("matches' error" in reason.reason for reason in found.reasons)


def test_a_photo_of_another_lens_is_named():
    model, graph = ordinary_building()
    found = grade(with_focal(model, {5: 1.4}), graph)
    assert found.other_focal == found.contradicted == (model.views[5].name,)
    assert found.word != "good"
    given = np.repeat(False, 2)
    given[1] = True
    exact = grade_run(run_of(with_focal(model, {5: 1.4}), graph), graph, given, OPTIONS, 0, 2)
    assert exact.other_focal == ()  # nobody asks what was given


def test_pairs_tell_the_focal_length_of_one_photo():
    model, graph = ordinary_building()
    changed = with_focal(model, {5: 1.1})
    pairs = evidence_of_pairs(
        changed, graph, pairs_to_ask(model, graph, 150, np.random.default_rng(0)), TwoViewOptions(), 0, 2
    )
    found = focal_evidence(pairs, graph)
    assert found.change[5] == pytest.approx(-np.log(1.1), abs=0.3 * np.log(1.1))
    others = np.delete(found.change / found.sd, 5)
    assert np.abs(others).max() < 5.0


def test_a_folded_building_is_doubtful():
    model, graph = ordinary_building()
    turn = Rigid3(exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    folded = with_poses(model, {k: model.pose_of(k) @ turn for k in range(PHOTOS // 2, PHOTOS)})
    found = grade(folded, graph)
    assert found.word == "doubtful"
    assert found.matches_kept is not None
    assert found.matches_kept < 0.95


@pytest.mark.parametrize("silent", [None, "error_added", "lost", "denied", "turned"])
def test_what_is_off_by_every_measure_is_doubtful_though_far_off_by_none(silent):
    model, graph = ordinary_building()
    bent = with_poses(
        model, {k: model.pose_of(k) @ Rigid3(exp(np.array([0.0, 0.0, 0.3])), np.zeros(3)) for k in (3, 4)}
    )
    limits = dict.fromkeys(("error_added", "lost", "denied", "turned"), Limits(0.0, 1.0))
    limits |= {} if silent is None else {silent: Limits(1.0, 1.0)}
    word = grade(bent, graph, options=replace(OPTIONS, **limits, contradicted=Limits(0.0, 1.0))).word
    assert word == ("doubtful" if silent is None else "weak")


def test_a_mirrored_model_is_doubtful():
    model, graph = ordinary_building()
    flip = np.diag([1.0, 1.0, -1.0])
    poses = {k: model.pose_of(k) for k in range(PHOTOS)}
    found = grade(with_poses(model, {k: Rigid3(flip @ p.R @ flip, flip @ p.t) for k, p in poses.items()}), graph)
    assert found.word == "doubtful"


def test_one_photo_in_a_wrong_place_is_named():
    model, graph = ordinary_building()
    away = Rigid3(exp(np.array([0.0, np.deg2rad(12.0), 0.0])), np.array([0.4, 0.0, 0.0]))
    found = grade(with_poses(model, {3: away @ model.pose_of(3)}), graph)
    assert found.contradicted == (model.views[3].name,)
    assert found.word != "good"


def test_pairs_that_were_left_out_make_a_model_weak():
    model, graph = ordinary_building()
    pairs = [pair for pair, two_view in graph.two_views.items() if two_view.inliers.any()]
    gone = {pair: degenerate(len(graph.matches[pair])) for pair in pairs[::4]}
    left = graph.with_two_views({**graph.two_views, **gone})
    found = grade_run(run_of(model, left), graph, FREE, OPTIONS, 0, 2)
    assert [reason.word for reason in found.reasons] == ["weak"]
    assert f"{len(gone)} of {len(pairs)} pairs" in found.reasons[0].reason


@pytest.mark.parametrize(("ratio", "word"), [(1.01, "good"), (1.03, "weak"), (1.3, "doubtful")])
def test_pixels_are_square_unless_they_are_given(ratio, word):
    model, graph = ordinary_building()
    _, fy, *rest = model.cameras[0].params.tolist()
    wrong = replace(model, cameras=(replace(model.cameras[0], params=np.array([ratio * fy, fy, *rest])),))
    words = [reason.word for reason in grade(wrong, graph).reasons if "square" in reason.reason]
    assert words == ([] if word == "good" else [word])
    assert not any("square" in reason.reason for reason in grade(wrong, graph, np.array([True])).reasons)


def test_cameras_that_are_assumed_make_a_model_weak():
    model, graph = ordinary_building()
    run = replace(run_of(model, graph), certainties=(CameraCertainty((None,), "assumed", "nobody knows"),))
    found = grade_run(run, graph, FREE, OPTIONS, 0, 2)
    assert [(reason.word, "nobody knows" in reason.reason) for reason in found.reasons] == [("weak", True)]
    assert grade_run(run, graph, np.array([True]), OPTIONS, 0, 2).word == "good"


@pytest.mark.parametrize(("sd_percent", "word"), [(0.3, "good"), (2.0, "weak")])
def test_a_focal_length_with_a_large_standard_deviation_makes_a_model_weak(sd_percent, word):
    model, graph = ordinary_building()
    sd = 0.01 * sd_percent * float(model.cameras[0].params[0])
    run = replace(run_of(model, graph), certainties=(CameraCertainty((sd,), "weak", "known roughly"),))
    assert grade_run(run, graph, FREE, OPTIONS, 0, 2).word == word


def test_an_alternative_makes_a_model_weak():
    model, graph = ordinary_building()
    assert grade_run(replace(run_of(model, graph), alternative=(model,)), graph, FREE, OPTIONS, 0, 2).word == "weak"


def test_no_model_is_doubtful():
    model, graph = ordinary_building()
    nothing = replace(model, views=tuple(replace(v, cam_from_world=None) for v in model.views))
    assert grade(nothing, graph).word == "doubtful"


def test_limits_are_in_order():
    with pytest.raises(ValueError, match="weak comes before doubtful"):
        Limits(0.5, 0.2)


def chain(groups: list[list[int]], points_each: int, extra: int = 0) -> Reconstruction:
    """Every group of views sees so many points of its own; the last view sees `extra` of its first group only."""
    view, point = [], []
    for g, members in enumerate(groups):
        for k in range(points_each):
            view += members
            point += [g * points_each + k] * len(members)
    n = 1 + max(max(members) for members in groups)
    total = points_each * len(groups)
    poses = tuple(View(f"{k}", 0, Rigid3(np.eye(3), np.zeros(3))) for k in range(n + (extra > 0)))
    view += [n] * extra
    point += list(range(extra))
    order = np.argsort(point, kind="stable")
    keypoint = np.arange(len(view))
    observations = Observations(np.array(view)[order], keypoint, np.array(point)[order], np.zeros((len(view), 2)))
    model, _ = ordinary_building()
    return Reconstruction(
        model.cameras, poses, Points(np.zeros((total, 3)), np.zeros((total, 3), np.uint8)), observations
    )


def test_a_photo_that_holds_two_parts_together_is_a_hinge():
    assert hinges(chain([[0, 1, 2], [2, 3, 4]], 20), 15) == {2: 2}
    assert hinges(chain([[0, 1, 2], [1, 2, 3]], 20), 15) == {}
    assert hinges(chain([[0, 1, 2], [2, 3]], 20), 15) == {}  # one photo alone is no part


def test_photos_with_few_points_are_weakly_held():
    assert weakly_held(chain([[0, 1, 2]], 40, extra=9), 30) == [3]


def test_derivatives_agree_with_differences():
    rng = np.random.default_rng(0)
    columns = np.concatenate([0.3 * rng.normal(size=(4, 20)), rng.uniform(1e-6, 2e-6, size=(2, 20))])
    pose = Rigid3(exp(np.array([0.1, -0.2, 0.05])), np.array([0.6, 0.0, 0.8]))

    def errors(step: np.ndarray) -> np.ndarray:
        flat1, flat2 = (np.diag([np.exp(-s), np.exp(-s), 1.0]) for s in step[5:])
        return sampson_px(flat2 @ essential_from_pose(moved(pose, step[:5])) @ flat1, columns)

    J, h = jacobian(pose, columns), 1e-6
    numeric = np.stack([(errors(h * e) - errors(-h * e)) / (2 * h) for e in np.eye(7)], axis=1)
    np.testing.assert_allclose(J, numeric, atol=1e-6 * np.abs(numeric).max())


def test_matches_at_both_epipoles_have_finite_derivatives():
    pose = Rigid3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    columns = np.array([[0.0, 0.1], [0.0, 0.2], [0.0, 0.1], [0.0, 0.3], [1e-6, 1e-6], [1e-6, 1e-6]])
    assert np.isfinite(jacobian(pose, columns)).all()


def test_photos_at_one_place_and_lenses_without_an_inverse_are_passed_over():
    model, graph = ordinary_building()
    same = with_poses(
        model, {1: replace(model.pose_of(1), t=model.pose_of(1).R @ -model.pose_of(0).target_origin_in_source())}
    )
    assert evidence_of_pairs(same, graph, [(0, 1)], TwoViewOptions(), 0, 1) == []
    folding = Camera("SIMPLE_RADIAL", 1000, 750, np.array([800.0, 505.0, 370.0, -3.0]))
    assert grade(replace(model, cameras=(folding,)), graph).word == "doubtful"


def test_noise_alone_asks_for_no_other_focal_length():
    """Errors in both photos bias the score unless the denominator takes part: five standard errors over 60 pairs."""
    rng = np.random.default_rng(1)
    sigma, z = 2e-3, []
    pose = Rigid3(exp(np.array([0.0, -0.4, 0.0])), np.array([0.9701425, 0.0, 0.2425356]))
    for _ in range(60):
        points = rng.uniform([-2, -2, 4], [2, 2, 8], size=(300, 3))
        in_2 = pose.apply(points)
        exact = np.concatenate([points[:, :2] / points[:, 2:], in_2[:, :2] / in_2[:, 2:]], axis=1)
        columns = np.concatenate([(exact + sigma * rng.normal(size=exact.shape)).T, np.full((2, 300), sigma**2)])
        J, r = jacobian(pose, columns), sampson_px(essential_from_pose(pose), columns)
        gradient, information = J.T @ r, J.T @ J
        z.append(gradient / np.sqrt(np.diag(information)))
    assert np.abs(np.mean(z, axis=0)).max() < 5.0 / np.sqrt(60)
