from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import uncalibrated_pairs, verify_pairs
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.incremental.options import IncrementalOptions
from fieldstone.mapping.model import refinement
from fieldstone.mapping.model.calibration import FOCAL_SIGMA
from fieldstone.mapping.model.refinement import RefinementOptions
from fieldstone.mapping.model.triangulation import covering_tracks, retriangulate
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.mapping.self_calibration import _leave_one_out, prediction_errors
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import build_tracks
from fieldstone.solve.averaging.focal_lengths import FocalPrior, estimate_focals
from fieldstone.solve.bundle.adjustment import bundle_adjust
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_reconstruction_near

OFF_CENTER = Camera("PINHOLE", 1000, 750, np.array([800.0, 800.0, 515.0, 366.0]))


def scene_of(seed: int = 0, **options) -> SyntheticScene:
    defaults = {"num_cameras": 8, "num_points": 500, "layout": "arc", "noise_px": 0.5, "camera": OFF_CENTER}
    return synthesize(SceneOptions(**(defaults | options)), np.random.default_rng(seed))


def map_scene(scene: SyntheticScene, cameras, known: bool, seed: int = 0, graph: MatchGraph | None = None):
    graph = graph or scene.graph
    camera_of_image = np.zeros(graph.num_images, dtype=np.int64)
    graph = verify_pairs(graph, cameras, camera_of_image, TwoViewOptions(), seed, 2)
    return map_automatic(
        graph, cameras, camera_of_image, np.array([0.0 if known else FOCAL_SIGMA]), AutomaticOptions(), seed
    )


@pytest.mark.parametrize("seed", range(2))
def test_known_cameras_are_placed_among_noise_and_outliers(seed):
    scene = scene_of(seed, outlier_share=0.4, num_clutter=100)
    run = map_scene(scene, scene.truth.cameras, known=True, seed=seed)
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.2, relative_distance=0.005)
    errors = run.reconstruction.reprojection_errors()
    assert np.sqrt(np.mean(errors**2) / 2) < 0.55
    assert run.reconstruction.cameras[0] is scene.truth.cameras[0]


def test_exact_matches_give_exact_poses():
    scene = scene_of(noise_px=0.0)
    run = map_scene(scene, scene.truth.cameras, known=True)
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=1e-4, relative_distance=1e-5)


def test_unknown_cameras_are_calibrated_by_their_own_photos():
    """No EXIF, focal length 800 px, principal point off the centre: by vote, bundle adjustment and model selection.

    All axes meet in one point here, which is where a vote on fundamental matrices is at its worst.
    """
    scene = scene_of(num_points=1500, layout="ring", num_cameras=12, noise_px=0.3)
    guess = Camera("SIMPLE_PINHOLE", 1000, 750, np.array([1200.0, 500.0, 375.0]))
    one = np.zeros(12, dtype=np.int64)
    pairs = uncalibrated_pairs(scene.graph, sorted(scene.graph.matches), (guess,), one, TwoViewOptions(), 0, 2)
    prior = FocalPrior(np.log([1.2]), np.array([0.45]), np.array([np.nan]))
    ratio = float(np.exp(estimate_focals(pairs.parallax, one, prior).log_focal[0]))
    assert 0.5 < ratio * 1000 / 800 < 2
    voted = replace(guess, params=np.array([ratio * 1000, 500.0, 375.0]))
    run = map_scene(scene, (voted,), known=False)
    camera = run.reconstruction.cameras[0]
    assert abs(camera.focal.mean() - 800) < 2
    np.testing.assert_allclose(camera.principal_point, [515, 366], atol=2)
    assert "OPENCV" not in camera.model
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.3, relative_distance=0.005)


def test_photos_that_share_no_camera_are_calibrated_each_on_its_own():
    """One lens took them all, and nobody knows: every photo starts with a focal length of its own, up to 8 % off."""
    scene = scene_of(
        num_points=1000, noise_px=0.3, camera=Camera("PINHOLE", 1000, 750, np.array([800.0, 800, 500, 375]))
    )
    off = np.linspace(0.92, 1.08, 8)
    cameras = tuple(Camera("SIMPLE_PINHOLE", 1000, 750, np.array([800.0 * share, 500.0, 375.0])) for share in off)
    graph = verify_pairs(scene.graph, cameras, np.arange(8), TwoViewOptions(), 0, 2)
    run = map_automatic(graph, cameras, np.arange(8), np.full(8, FOCAL_SIGMA), AutomaticOptions(), 0)
    found = np.array([camera.focal.mean() for camera in run.reconstruction.cameras])
    np.testing.assert_allclose(found / 800, 1.0, atol=0.01)


def test_result_is_the_same_for_any_number_of_threads(monkeypatch):
    scene = scene_of(outlier_share=0.2)
    camera_of_image, focal_sigma = np.zeros(8, dtype=np.int64), np.array([FOCAL_SIGMA])
    refinement_options = RefinementOptions(min_observations_for_threads=0)
    options = AutomaticOptions(incremental=IncrementalOptions(refinement=refinement_options))
    runs, threads_used = [], []

    def adjust(problem, bundle):
        threads_used.append(bundle.threads)
        return bundle_adjust(problem, bundle)

    monkeypatch.setattr(refinement, "bundle_adjust", adjust)
    for threads in (1, 3):
        graph = verify_pairs(scene.graph, scene.truth.cameras, camera_of_image, TwoViewOptions(), 5, threads)
        each = options.with_threads(threads)
        runs.append(map_automatic(graph, scene.truth.cameras, camera_of_image, focal_sigma, each, 5))
    assert set(threads_used) == {1, 3}
    first, second = (run.reconstruction for run in runs)
    np.testing.assert_array_equal(first.points.xyz, second.points.xyz)
    np.testing.assert_array_equal(first.cameras[0].params, second.cameras[0].params)


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_progress_counts_photos_and_models(mapper):
    scene, events = scene_of(), []
    camera_of_image, exact = np.zeros(8, dtype=np.int64), np.zeros(1)
    graph = verify_pairs(scene.graph, scene.truth.cameras, camera_of_image, TwoViewOptions(), 0, 2, events.append)
    options = AutomaticOptions(mapper=mapper)
    map_automatic(graph, scene.truth.cameras, camera_of_image, exact, options, 0, on_progress=events.append)
    assert list(dict.fromkeys(e.stage for e in events)) == ["verifying pairs", "registering photos", "finishing models"]
    for stage, total in (("verifying pairs", len(graph.matches)), ("registering photos", 8), ("finishing models", 1)):
        done = [e.done for e in events if e.stage == stage]
        assert done[0] == 0
        assert done == sorted(done)
        assert done[-1] == total
        assert {e.total for e in events if e.stage == stage} == {total}


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_photos_of_more_pixels_than_the_detector_saw_give_the_same_model(mapper):
    """The same photos with twice or three times the pixels: thresholds grow with them, focal length and noise too."""
    scene = scene_of(outlier_share=0.2)
    zoom = np.where(np.arange(8) < 5, 2.0, 3.0)
    cameras = tuple(Camera("PINHOLE", 1000 * z, 750 * z, z * OFF_CENTER.params) for z in (2, 3))
    larger = replace(
        scene.graph, keypoints=tuple(k * z for k, z in zip(scene.graph.keypoints, zoom, strict=True)), pixel_scale=zoom
    )
    camera_of_image, options = (zoom == 3.0).astype(np.int64), AutomaticOptions(mapper=mapper, covariance=True)
    graph = verify_pairs(larger, cameras, camera_of_image, TwoViewOptions(), 0, 2)
    run = map_automatic(graph, cameras, camera_of_image, np.zeros(2), options, 0)
    plain = verify_pairs(scene.graph, [OFF_CENTER] * 2, camera_of_image, TwoViewOptions(), 0, 2)
    expected = map_automatic(plain, [OFF_CENTER] * 2, camera_of_image, np.zeros(2), options, 0)
    assert_reconstruction_near(run.reconstruction, expected.reconstruction, angle_deg=1e-4, relative_distance=1e-5)
    assert len(run.reconstruction.observations) == len(expected.reconstruction.observations)
    assert run.uncertainty is not None
    assert expected.uncertainty is not None
    np.testing.assert_allclose(run.uncertainty.rotation_deg, expected.uncertainty.rotation_deg, rtol=1e-3)
    assert run.uncertainty.sigma_px == pytest.approx(2.0 * expected.uncertainty.sigma_px, rel=1e-3)


def test_two_unrelated_scenes_become_two_models():
    a, b = scene_of(1, num_cameras=6), scene_of(2, num_cameras=4)
    graph = MatchGraph(
        tuple(f"a{n}" for n in a.graph.names) + tuple(f"b{n}" for n in b.graph.names),
        a.graph.keypoints + b.graph.keypoints,
        a.graph.colors + b.graph.colors,
        {**a.graph.matches, **{(i + 6, j + 6): rows for (i, j), rows in b.graph.matches.items()}},
    )
    run = map_scene(a, a.truth.cameras, known=True, graph=graph)
    assert run.reconstruction.registered().tolist() == list(range(6))
    assert [model.registered().tolist() for model in run.others] == [[6, 7, 8, 9]]
    assert run.verdicts["b" + b.graph.names[0]].startswith("in a model of its own (2 of 2)")


def test_photos_that_only_turn_give_no_model_but_verdicts():
    scene = scene_of(num_cameras=3)
    truth = scene.truth
    R = truth.pose_of(0).R
    rng = np.random.default_rng(3)
    points = rng.uniform([-2, -2, 4], [2, 2, 9], size=(400, 3)) @ R
    keypoints = []
    for k in range(3):
        turned = points @ R.T @ np.linalg.qr(np.eye(3) + 0.03 * k * rng.normal(size=(3, 3)))[0].T
        turned[:, 2] = np.abs(turned[:, 2])
        keypoints.append(image_from_cam(OFF_CENTER, turned))
    rows = np.stack([np.arange(400)] * 2, axis=1)
    colors = (np.zeros((400, 3), dtype=np.uint8),) * 3
    graph = MatchGraph(("x", "y", "z"), tuple(keypoints), colors, {(0, 1): rows, (0, 2): rows, (1, 2): rows})
    run = map_scene(scene, truth.cameras, known=True, graph=graph)
    assert len(run.reconstruction.registered()) == 0
    assert all(verdict.startswith("not registered") for verdict in run.verdicts.values())


def exact_model(num_cameras: int = 6) -> tuple[SyntheticScene, WorkingModel]:
    scene = scene_of(num_cameras=num_cameras, num_points=200, noise_px=0.0, visibility=0.7)
    tracks, _ = build_tracks(scene.verified_graph())
    model = WorkingModel.start(scene.truth.cameras, np.zeros(num_cameras, dtype=np.int64), tracks)
    for view in range(num_cameras):
        model = model.with_pose(view, scene.truth.pose_of(view))
    everything = np.ones(len(model.xyz), dtype=bool)
    return scene, retriangulate(model, everything, max_error_px=2.0, min_angle_deg=0.1)


def test_covering_tracks_give_every_view_its_share_and_prefer_long_tracks():
    _, model = exact_model()
    chosen = covering_tracks(model, 20)
    rows = model.used_observations()
    rows = rows[chosen[model.tracks.point[rows]]]
    assert np.bincount(model.tracks.view[rows], minlength=6).min() >= 20
    lengths = np.bincount(model.tracks.point[model.used_observations()], minlength=len(model.xyz))
    assert lengths[chosen].mean() > lengths[~chosen & model.is_point()].mean()
    assert covering_tracks(model, 10**6)[model.is_point()].all()


def test_predictions_leave_out_exactly_their_target():
    point = np.array([0, 0, 0, 1, 1, 1, 1])
    predictions = _leave_one_out(point)
    for k, target in enumerate(predictions.target):
        members = predictions.members[predictions.starts[k] : predictions.starts[k + 1]]
        assert sorted([*members, target]) == np.flatnonzero(point == point[target]).tolist()
    assert len(_leave_one_out(np.empty(0, dtype=np.int64)).target) == 0
    _, model = exact_model()
    rows = model.used_observations()
    lengths = np.bincount(model.tracks.point[rows])
    rows = rows[lengths[model.tracks.point[rows]] >= 3]
    found = prediction_errors(model, rows, _leave_one_out(model.tracks.point[rows]))
    assert np.median(found) < 1e-6
    shifted = replace(model.tracks, pixels=model.tracks.pixels + np.eye(len(model.tracks))[rows[0]][:, None] * 30.0)
    worse = prediction_errors(replace(model, tracks=shifted), rows, _leave_one_out(model.tracks.point[rows]))
    assert worse[0] > 10
