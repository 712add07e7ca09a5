from dataclasses import replace

import numpy as np
import pytest

from bundle_worlds import CAMERAS, mixed_problem, perturbed, without_refinement
from fieldstone.geometry.camera import image_from_cam
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.partial_refinement import refine_points, refine_pose
from fieldstone.solve.bundle.problem import reprojection_residuals
from fieldstone.solve.bundle.scipy_reference import bundle_adjust_scipy
from fieldstone.solve.robust.loss import huber
from matchers import assert_rigid3_near

TIGHT = BundleOptions(relative_tolerance=1e-14, max_iterations=100)


def moved_points(scale: float = 0.05):
    problem = without_refinement(mixed_problem(noise_px=0.7))
    problem = replace(problem, fixed_views=np.ones(6, dtype=bool))
    step = scale * np.random.default_rng(2).normal(size=problem.points.shape)
    return replace(problem, points=problem.points + step * ~problem.fixed_points[:, None])


@pytest.mark.parametrize("threads", [1, 3])
def test_points_reach_the_minimum_that_scipy_finds(threads):
    problem = moved_points()
    options = replace(TIGHT, loss="huber", loss_scale_px=0.8, threads=threads)
    result = refine_points(problem, options)
    oracle = bundle_adjust_scipy(problem, loss=huber(0.8), relative_tolerance=1e-15, max_evaluations=500)
    assert result.final_cost == pytest.approx(oracle.final_cost, rel=1e-7)
    np.testing.assert_allclose(result.problem.points, oracle.problem.points, atol=1e-4)
    np.testing.assert_array_equal(result.problem.points[3], problem.points[3])
    np.testing.assert_array_equal(
        result.problem.points, refine_points(problem, replace(options, threads=1)).problem.points
    )


def test_refinement_of_points_holds_what_the_problem_would_refine():
    problem = perturbed(mixed_problem())
    result = refine_points(problem)
    assert result.final_cost < result.initial_cost
    np.testing.assert_array_equal(result.problem.cam_from_world.R, problem.cam_from_world.R)
    assert result.problem.cameras == problem.cameras
    residuals = reprojection_residuals(result.problem)
    assert result.final_cost == pytest.approx(0.5 * np.sum(residuals**2), rel=1e-12)


def test_points_unseen_or_behind_keep_their_place():
    problem = moved_points()
    keep = problem.point != 6
    points = problem.points.copy()
    points[9] = [0.0, 0.0, -60.0]
    problem = replace(
        problem, points=points, view=problem.view[keep], point=problem.point[keep], pixels=problem.pixels[keep]
    )
    result = refine_points(problem, TIGHT)
    np.testing.assert_array_equal(result.problem.points[6], points[6])
    assert np.all(np.isfinite(result.problem.points))
    depth = problem.cam_from_world[problem.view].apply(result.problem.points[problem.point])[:, 2]
    assert np.all(depth[result.usable] > 0)


@pytest.mark.parametrize("camera", CAMERAS)
def test_pose_and_focal_length_of_one_view_are_recovered(camera):
    rng = np.random.default_rng(0)
    truth = mixed_problem().cam_from_world[0]
    points = rng.uniform(-1, 1, size=(40, 3))
    pixels = image_from_cam(camera, truth.apply(points))
    start = truth.retract(0.05 * rng.normal(size=6))
    pose, same, result = refine_pose(camera, start, points, pixels, TIGHT)
    assert_rigid3_near(pose, truth)
    assert same is camera
    assert result.final_cost < 1e-15
    refine = np.arange(len(camera.params)) < camera.spec.num_focal
    wrong = replace(camera, params=np.where(refine, 1.05, 1.0) * camera.params)
    pose, found, _ = refine_pose(wrong, start, points, pixels, TIGHT, refine=refine)
    assert_rigid3_near(pose, truth)
    np.testing.assert_allclose(found.params, camera.params, rtol=1e-7)


def test_one_view_agrees_with_the_whole_bundle():
    problem = without_refinement(mixed_problem(noise_px=0.7))
    seen = problem.view == 0
    one = replace(problem, fixed_points=np.ones(len(problem.points), dtype=bool), fixed_views=np.arange(6) != 0)
    whole = bundle_adjust(one, TIGHT)
    pose, _, _ = refine_pose(
        problem.cameras[0], problem.cam_from_world[0], problem.points[problem.point[seen]], problem.pixels[seen], TIGHT
    )
    assert_rigid3_near(pose, whole.problem.cam_from_world[0], angle=1e-7, distance=1e-7)
