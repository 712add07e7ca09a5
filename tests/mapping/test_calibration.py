from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.model.calibration import (
    ASPECT_SIGMA,
    CANDIDATE_STEPS,
    FOCAL_SIGMA,
    PRINCIPAL_POINT_SIGMA,
    as_model,
    first_step,
    priors,
    richer_steps,
    what_is_wrong_with,
)
from fieldstone.scene.alignment import align
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, synthesize
from matchers import assert_reconstruction_near

PLAIN = Camera("SIMPLE_PINHOLE", 640, 480, np.array([500.0, 322.0, 238.0]))
RADIAL = Camera("RADIAL", 640, 480, np.array([500.0, 320, 240, 0.1, -0.05]))
FISHEYE = Camera("OPENCV_FISHEYE", 1000, 750, np.array([520.0, 521.0, 508.0, 371.0, 0.03, -0.01, 0.004, -0.001]))


@pytest.mark.parametrize("step", CANDIDATE_STEPS[:-1], ids=lambda step: f"{step.model} {len(step.free)}")
def test_a_camera_in_a_richer_model_sees_the_same(step):
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], size=(50, 3))
    rich = as_model(PLAIN, step.model)
    np.testing.assert_array_equal(image_from_cam(rich, points), image_from_cam(PLAIN, points))
    assert step.mask().sum() == len(step.free)
    assert {prior.param for prior in priors([rich], [step])} == set(np.flatnonzero(step.mask()).tolist())


def test_a_model_that_cannot_express_the_camera_is_refused():
    assert as_model(RADIAL, "OPENCV").coefficients.tolist() == [0.1, -0.05, 0, 0]
    for camera, model in ((RADIAL, "SIMPLE_RADIAL"), (FISHEYE, "FULL_OPENCV")):
        with pytest.raises(ValueError, match="cannot express"):
            as_model(camera, model)


@pytest.mark.parametrize("camera", [PLAIN, RADIAL, as_model(RADIAL, "FULL_OPENCV")], ids=lambda camera: camera.model)
def test_a_fisheye_camera_is_fitted_to_what_another_one_sees(camera):
    """Within a quarter of a pixel, all over the photo, though the two laws share no parameter."""
    x, y = np.meshgrid(np.linspace(0, 640, 17), np.linspace(0, 480, 13))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = np.concatenate([plane_from_image(camera, pixels), np.ones((len(pixels), 1))], axis=1)
    seen = image_from_cam(as_model(camera, "OPENCV_FISHEYE"), rays)
    np.testing.assert_allclose(seen, pixels, atol=0.25)


def test_what_is_given_is_refined_in_the_first_model_that_expresses_it():
    cameras = {
        "SIMPLE_RADIAL": [PLAIN, Camera("OPENCV", 640, 480, np.array([500.0, 500, 320, 240, 0.1, 0, 0, 0]))],
        "RADIAL": [RADIAL, Camera("OPENCV", 640, 480, np.array([500.0, 500, 320, 240, 0.1, 0.02, 0, 0]))],
        "OPENCV": [
            Camera("PINHOLE", 640, 480, np.array([500.0, 510, 320, 240])),
            Camera("OPENCV", 640, 480, np.array([500.0, 500, 320, 240, 0.1, 0, 0.001, 0])),
        ],
        "FULL_OPENCV": [Camera("FULL_OPENCV", 640, 480, np.array([500.0, 500, 320, 240, 0, 0, 0, 0, 0, 0.1, 0, 0]))],
        "OPENCV_FISHEYE": [FISHEYE],
    }
    for model, all_of_it in cameras.items():
        for camera in all_of_it:
            step = first_step(camera)
            assert step.model == model
            as_model(camera, model)
            assert not any("cx" in other.free for other in richer_steps(step, principal_point=False))


def test_every_step_above_refines_more():
    for step in CANDIDATE_STEPS:
        above = richer_steps(step)
        assert step not in above
        assert all(set(other.free) > set(step.free) for other in above if other.model == step.model)
        assert [CANDIDATE_STEPS.index(other) for other in above] == sorted(
            CANDIDATE_STEPS.index(other) for other in above
        )
    assert richer_steps(CANDIDATE_STEPS[-1]) == []


STEP = {step.model: step for step in CANDIDATE_STEPS}


@pytest.mark.parametrize(
    ("camera", "wrong"),
    [
        (RADIAL, ""),
        # The corner is at 0.8 focal lengths: 0.8^4 k2 is 1 where the bound is, and the photo is ten times as wide.
        (Camera("RADIAL", 640, 480, np.array([500.0, 320, 240, 0.1, 0.8**-4])), "k2 is at its bound"),
        (Camera("RADIAL", 640, 480, np.array([500.0, 320, 240, 0.1, 0.9 * 0.8**-4])), ""),
        (Camera("SIMPLE_RADIAL", 640, 480, np.array([500.0, 320, 240, -0.3])), "its distortion cannot be inverted"),
        (as_model(PLAIN, "OPENCV_FISHEYE"), "the angles are not those of a fisheye"),
        (replace(FISHEYE, params=FISHEYE.params * np.where(np.arange(8) < 2, 0.6, 1.0)), ""),
    ],
)
def test_what_is_no_lens_is_told(camera, wrong):
    """A barrel of k = -0.3 turns back where its radius is 0.70 focal lengths."""
    told = what_is_wrong_with(camera, STEP[camera.model])
    assert told.startswith(wrong)
    assert bool(told) == bool(wrong)


def test_a_bound_of_a_parameter_that_is_held_is_none():
    at_bound = Camera("RADIAL", 640, 480, np.array([500.0, 320, 240, 0.1, 0.8**-4]))
    assert what_is_wrong_with(at_bound, replace(STEP["RADIAL"], free=("f", "k1"))) == ""


def test_priors_are_about_the_camera_that_is_given():
    """Its focal lengths, their ratio and its principal point; wherever the camera has moved since."""
    given = Camera("PINHOLE", 640, 480, np.array([500.0, 550.0, 300.0, 250.0]))
    step = replace(STEP["OPENCV"], prior=first_step(given, 0.1).prior)
    moved = Camera("OPENCV", 640, 480, np.array([510.0, 540.0, 310.0, 245.0, 0, 0, 0, 0]))
    found = {(prior.param, prior.of): prior for prior in priors([moved], [step])}
    assert found[0, None].mean == pytest.approx(500.0)
    assert found[1, None].mean == pytest.approx(550.0)
    assert found[0, 1].ratio == pytest.approx(500.0 / 550.0)
    assert found[0, 1].sigma == pytest.approx(ASPECT_SIGMA * 510.0)
    assert (found[2, None].mean, found[3, None].mean) == (300.0, 250.0)
    assert found[2, None].sigma == PRINCIPAL_POINT_SIGMA * 640
    # Two numbers of standard deviation s sqrt(2) have a mean of standard deviation s.
    assert found[0, None].sigma == pytest.approx(0.1 * 500.0 * np.sqrt(2.0))


def map_with(truth: Camera, start: Camera, focal_sigma: float = FOCAL_SIGMA, **scene_options):
    options = {"num_cameras": 10, "num_points": 1200, "layout": "arc", "noise_px": 0.3, "camera": truth}
    scene = synthesize(SceneOptions(**(options | scene_options)), np.random.default_rng(0))
    camera_of_image = np.zeros(scene.graph.num_images, dtype=np.int64)
    graph = verify_pairs(scene.graph, [start], camera_of_image, TwoViewOptions(), 0, 2)
    return scene, map_automatic(graph, [start], camera_of_image, np.array([focal_sigma]), AutomaticOptions(), 0)


def test_photos_overrule_a_prior_of_the_focal_length_as_far_as_it_is_wide():
    """Where they tell it; a prior that is narrower than what they tell is kept."""
    truth, start = (Camera("SIMPLE_PINHOLE", 1000, 750, np.array([f, 500.0, 375.0])) for f in (800.0, 832.0))
    found = [map_with(truth, start, sigma)[1].reconstruction.cameras[0].focal[0] for sigma in (FOCAL_SIGMA, 0.05, 1e-6)]
    assert found[:2] == pytest.approx([800.0, 800.0], rel=0.003)
    assert found[2] == pytest.approx(832.0, rel=0.001)


def test_given_fisheye_cameras_are_refined():
    start = replace(FISHEYE, params=FISHEYE.params + np.array([6.0, 7.0, -8, 4, -0.03, 0.01, -0.004, 0.001]))
    scene, run = map_with(FISHEYE, start)
    camera = run.reconstruction.cameras[0]
    assert camera.model == "OPENCV_FISHEYE"
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.1, relative_distance=0.005)
    np.testing.assert_allclose(camera.focal, FISHEYE.focal, rtol=0.003)


def test_a_strong_fisheye_lens_is_recognised():
    """Nothing but a focal length is given; the photos see 140 degrees across."""
    truth = Camera("OPENCV_FISHEYE", 1000, 750, np.array([380.0, 380.0, 500.0, 375.0, 0.0, 0.0, 0.0, 0.0]))
    start = Camera("SIMPLE_PINHOLE", 1000, 750, np.array([380.0, 500.0, 375.0]))
    scene, run = map_with(truth, start, layout="street", num_points=2000)
    assert run.reconstruction.cameras[0].model == "OPENCV_FISHEYE"
    _, told = map_with(truth, truth, layout="street", num_points=2000)
    found, best = (align(r.reconstruction, scene.truth).rotation_error.max() for r in (run, told))
    assert len(run.reconstruction.registered()) == len(scene.truth.views)
    assert found < 1.5 * best  # as if the lens had been given


@pytest.mark.parametrize(
    "truth",
    [
        Camera("OPENCV", 1000, 750, np.array([800.0, 806.0, 515.0, 366.0, 0.05, -0.02, 0.002, -0.001])),
        Camera("PINHOLE", 1000, 750, np.array([800.0, 840.0, 500.0, 375.0])),
    ],
    ids=lambda camera: camera.model,
)
def test_given_rich_cameras_are_refined_in_their_model(truth):
    start = replace(truth, params=truth.params * np.where(np.arange(len(truth.params)) < 2, 1.02, 1.0))
    scene, run = map_with(truth, start)
    assert run.reconstruction.cameras[0].spec.num_focal == 2
    np.testing.assert_allclose(run.reconstruction.cameras[0].focal, truth.focal, rtol=0.003)
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.1, relative_distance=0.005)
