"""Which camera model is believed: the rule on made predictions, and the whole on made scenes."""

from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.mapping import automatic
from fieldstone.mapping.automatic import AutomaticOptions, FinishedModel, finish, register
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.mapping.model import calibration as calibration_module
from fieldstone.mapping.model.calibration import (
    CANDIDATE_STEPS,
    FOCAL_SIGMA,
    CalibrationStep,
    LensPrior,
    with_free_aspect,
)
from fieldstone.mapping.model.refinement import RefinementOptions, adjust_globally
from fieldstone.mapping.model.uncertainty import camera_certainties
from fieldstone.mapping.self_calibration import (
    SelfCalibrationOptions,
    _Candidate,
    _Jury,
    _simplest_of_the_best,
    _standard_error,
    select_camera_models,
)
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize

PLAIN = Camera("SIMPLE_PINHOLE", 1000, 750, np.array([800.0, 500.0, 375.0]))
OPTIONS = SelfCalibrationOptions()


def jury_of(track, view) -> _Jury:
    return _Jury((), np.asarray(track), np.asarray(view), RefinementOptions())


def candidate(step: int, errors, wrong: str = "") -> _Candidate:
    return _Candidate((CANDIDATE_STEPS[step],), np.asarray(errors, dtype=float), wrong, 0.0)


def test_standard_errors_count_what_depends_on_each_other_once():
    """Errors with a part of the track, a part of the photo and one of their own: variances of the mean in closed form.

    30 x 40 predictions; 400 draws tell the scatter of the mean to 3.5 %, and one draw its own standard error to the
    15 % that 30 photos allow.
    """
    track, view = (index.ravel() for index in np.indices((40, 30)))
    promised, means = [], []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        values = 0.5 * rng.normal(size=40)[track] + 1.0 * rng.normal(size=30)[view] + rng.normal(size=1200)
        promised.append(_standard_error(values, jury_of(track, view)))
        means.append(values.mean())
    expected = np.sqrt(0.25 / 40 + 1.0 / 30 + 1.0 / 1200)
    assert np.std(means) == pytest.approx(expected, rel=0.15)
    assert np.mean(promised) == pytest.approx(expected, rel=0.05)


def test_the_simplest_within_one_standard_error_of_the_best_is_chosen():
    """Mean errors of 2.0 with a standard error of 0.01 / sqrt(99): what is above the limit is out, below it is in."""
    track = np.arange(100)
    jury = jury_of(track, track)
    spread = 2.0 + 0.1 * np.where(track % 2, 1.0, -1.0)
    error = _standard_error(spread, jury)
    assert error == pytest.approx(0.1 / np.sqrt(99), rel=1e-9)
    limit = max(error, OPTIONS.min_gain * 2.0)
    for worse, expected in ((1.1 * limit, 1), (0.9 * limit, 0)):
        lenses = [candidate(2, spread + worse), candidate(3, spread), candidate(4, spread + 1e-6)]
        assert _simplest_of_the_best(lenses, jury, OPTIONS) is lenses[expected]


def test_what_is_wrong_neither_wins_nor_sets_the_limit():
    jury = jury_of(np.arange(50), np.arange(50))
    flat = np.full(50, 2.0)
    lenses = [candidate(2, flat), candidate(3, flat - 1.0, wrong="k2 is at its bound"), candidate(4, flat - 0.5)]
    assert _simplest_of_the_best(lenses, jury, OPTIONS) is lenses[2]
    assert _simplest_of_the_best(lenses[1:2], jury, OPTIONS) is None


def registered(truth: Camera, seed: int = 0, **scene_options) -> tuple[SyntheticScene, SubModel]:
    """The photos of a made scene without noise on their places, registered from a focal length alone."""
    options = {"num_cameras": 12, "num_points": 1000, "noise_px": 0.5, "camera": truth} | scene_options
    scene = synthesize(SceneOptions(**options), np.random.default_rng(seed))
    one = np.zeros(scene.graph.num_images, dtype=np.int64)
    graph = verify_pairs(scene.graph, [PLAIN], one, TwoViewOptions(), 0, 2)
    return scene, register(graph, [PLAIN], one, np.array([FOCAL_SIGMA]), AutomaticOptions(), 0)[0]


@pytest.fixture(scope="module")
def facade():
    """A plane seen along parallel axes by a camera that moves beside it: focal lengths and the distance of the plane
    cannot be told apart, nor those of the two axes."""
    return registered(
        Camera("SIMPLE_PINHOLE", 1000, 750, PLAIN.params + [0, 12, -5]), layout="street", point_shape="plane"
    )


def test_pixels_stay_square_where_photos_do_not_tell(facade, monkeypatch):
    """Even in the richest model; without the prior, noise of half a pixel makes them several percent too wide."""
    _, sub_model = facade
    step = next(step for step in CANDIDATE_STEPS if step.model == "OPENCV")
    step = replace(step, prior=sub_model.calibration[0].prior)
    options = RefinementOptions()
    bundle = replace(options.final, relative_tolerance=1e-9, max_iterations=200)

    def aspect(step: CalibrationStep) -> float:
        model = sub_model.model
        fx, fy = adjust_globally(model, options, [step], bundle=bundle, points=model.is_point()).cameras[0].focal
        return fx / fy

    assert abs(aspect(step) - 1.0) < 0.002
    monkeypatch.setattr(calibration_module, "FREE_ASPECT_SIGMA", 1e3)
    assert abs(aspect(with_free_aspect(step)) - 1.0) > 0.02


def test_a_camera_that_photos_do_not_determine_is_simple_and_said_to_be_weak(facade):
    _, sub_model = facade
    found = finish(sub_model, AutomaticOptions())
    camera = found.model.cameras[0]
    assert camera.focal[0] == pytest.approx(camera.focal[1], rel=0.002)
    certainty = certainty_of(found)
    assert certainty.word == "weak"
    assert "focal length known to" in certainty.reason


def certainty_of(found: FinishedModel):
    return camera_certainties(found.model, found.calibration, found.refinement)[0]


@pytest.mark.parametrize("ratio", [1.03, 1.1])
def test_pixels_that_are_not_square_are_believed_with_proof(ratio):
    truth = Camera("PINHOLE", 1000, 750, np.array([800.0, 800.0 * ratio, 505.0, 370.0]))
    found = finish(registered(truth, layout="ring")[1], AutomaticOptions())
    np.testing.assert_allclose(found.model.cameras[0].focal, truth.focal, rtol=0.004)
    assert certainty_of(found).word == "well determined"


@pytest.mark.parametrize(
    ("truth", "layout"),
    [
        (Camera("SIMPLE_RADIAL", 1000, 750, np.array([800.0, 512.0, 370.0, 0.03])), "ring"),
        (Camera("RADIAL", 1000, 750, np.array([800.0, 512.0, 370.0, 0.1, -0.15])), "street"),
        (Camera("OPENCV", 1000, 750, np.array([800.0, 800.0, 512.0, 370.0, 0.1, -0.15, 0.01, -0.01])), "ring"),
    ],
)
def test_the_lens_is_found_and_its_parameters_within_their_standard_deviations(truth, layout):
    """On a ring all points are near the middle of the photos, where a second radial term does nothing; on a street
    they fill them."""
    _, sub_model = registered(truth, layout=layout)
    found = finish(sub_model, AutomaticOptions())
    camera, certainty = found.model.cameras[0], certainty_of(found)
    assert camera.model == truth.model
    sds = np.array([np.nan if sd is None else sd for sd in certainty.sds])
    free = np.isfinite(sds)
    assert free[0]
    assert np.all(np.abs(camera.params - truth.params)[free] < 4.0 * sds[free])


def test_the_choice_depends_on_no_draw(facade):
    """Tracks are dealt into folds in their order: two runs of the same model say the same, to the bit."""
    _, sub_model = facade
    refinement = AutomaticOptions().incremental.refinement
    first, again = (select_camera_models(sub_model.model, sub_model.calibration, refinement, OPTIONS) for _ in range(2))
    assert first == again
    assert sum(trial.accepted for trial in first[1]) == 1
    assert "OPENCV_FISHEYE" not in {trial.step.model for trial in first[1]}  # 76 degrees from corner to corner


def test_too_few_tracks_decide_nothing(facade):
    _, sub_model = facade
    options = replace(OPTIONS, min_judges=10**6)
    calibration, trials = select_camera_models(sub_model.model, sub_model.calibration, RefinementOptions(), options)
    assert calibration == tuple(sub_model.calibration)
    assert trials == []


def test_given_cameras_and_those_of_few_photos_are_assumed(facade):
    _, sub_model = facade
    model, refinement = sub_model.model, RefinementOptions()
    assert camera_certainties(model, [None], refinement)[0].word == "assumed"
    few = replace(refinement, min_views_for_intrinsics=model.num_views + 1)
    certainty = camera_certainties(model, sub_model.calibration, few)[0]
    assert certainty.word == "assumed"
    assert set(certainty.sds) == {None}
    assert "too few of its photos" in certainty.reason


def test_a_camera_of_one_photo_is_weak_whatever_its_standard_deviations():
    """The photo's errors sum to nothing where its own camera has been fitted to them."""
    _, sub_model = registered(PLAIN, layout="ring")
    model = sub_model.model
    of_view = np.where(np.arange(model.num_views) == 3, 1, 0)
    two = replace(model, cameras=(*model.cameras, *model.cameras), camera_of_view=of_view)
    steps = (*sub_model.calibration, *sub_model.calibration)
    shared, alone = camera_certainties(two, steps, RefinementOptions())
    assert shared.word == "well determined"
    assert (alone.word, alone.reason) == ("weak", "refined from 1 photos only")
    assert alone.sds[0] is not None


def test_a_model_that_all_tracks_make_no_lens_is_given_up(facade, monkeypatch):
    _, sub_model = facade
    rich = replace(CANDIDATE_STEPS[3], prior=LensPrior.of(PLAIN))
    monkeypatch.setattr(automatic, "select_camera_models", lambda *_: ((rich,), []))
    monkeypatch.setattr(automatic, "what_is_wrong_with", lambda camera, step: "wrong" * (camera.model == "RADIAL"))
    assert finish(sub_model, AutomaticOptions()).calibration == tuple(sub_model.calibration)
