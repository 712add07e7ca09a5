from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from bundle_worlds import mixed_problem, perturbed, without_refinement
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.models.bal import read_bal
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.camera_prior import CameraPrior
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_residuals
from fieldstone.solve.bundle.scipy_reference import bundle_adjust_scipy
from fieldstone.solve.robust.loss import cauchy, huber, soft_l1, trivial
from matchers import assert_rigid3_near
from real_data import data_folder

TIGHT = BundleOptions(relative_tolerance=1e-13, max_iterations=300)


def cost_of(problem: BundleProblem, loss=None) -> float:
    rho, _ = (loss or trivial())(np.sum(reprojection_residuals(problem) ** 2, axis=1))
    return 0.5 * float(np.sum(rho))


@pytest.mark.parametrize("fixed", [True, False])
def test_exact_data_is_recovered(fixed):
    truth = mixed_problem(noise_px=0.0, fixed=fixed)
    result = bundle_adjust(perturbed(truth), TIGHT)
    assert result.final_cost < 1e-15
    assert result.usable.all()
    if fixed:  # one held view and one held point leave no gauge but the scale, which view and point fix together
        np.testing.assert_allclose(result.problem.points, truth.points, atol=1e-6)
        assert_rigid3_near(result.problem.cam_from_world, truth.cam_from_world)
        for camera, expected in zip(result.problem.cameras, truth.cameras, strict=True):
            np.testing.assert_allclose(camera.params, expected.params, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "loss"),
    [("trivial", trivial()), ("huber", huber(0.6)), ("soft_l1", soft_l1(0.6)), ("cauchy", cauchy(2.0))],
)
def test_minimum_is_that_of_scipy(name, loss):
    problem = perturbed(mixed_problem(), scale=0.3)
    scale = 2.0 if name == "cauchy" else 0.6
    result = bundle_adjust(problem, replace(TIGHT, loss=name, loss_scale_px=scale))
    oracle = bundle_adjust_scipy(problem, loss=loss, relative_tolerance=1e-14, max_evaluations=300)
    assert result.initial_cost == pytest.approx(cost_of(problem, loss), rel=1e-12)
    assert result.final_cost == pytest.approx(cost_of(result.problem, loss), rel=1e-12)
    assert result.final_cost == pytest.approx(oracle.final_cost, rel=1e-6)
    assert_rigid3_near(result.problem.cam_from_world, oracle.problem.cam_from_world, angle=1e-4, distance=1e-3)
    np.testing.assert_allclose(result.problem.points, oracle.problem.points, atol=1e-3)


def test_costs_fall_and_fixed_parts_keep_their_bits():
    problem = perturbed(mixed_problem())
    result = bundle_adjust(problem)
    assert np.all(np.diff(result.costs) < 0)
    assert result.costs[0] == result.initial_cost
    assert result.costs[-1] == result.final_cost
    assert result.reason == "cost settled"
    np.testing.assert_array_equal(result.problem.cam_from_world.R[2], problem.cam_from_world.R[2])
    np.testing.assert_array_equal(result.problem.points[3], problem.points[3])
    for camera, before, mask in zip(result.problem.cameras, problem.cameras, problem.refine, strict=True):
        np.testing.assert_array_equal(camera.params[~mask], before.params[~mask])
        assert np.all(camera.params[mask] != before.params[mask])


@pytest.mark.parametrize(("num_views", "reach"), [(6, None), (100, 3)])
def test_any_number_of_threads_gives_the_same_bits(num_views, reach):
    problem = perturbed(mixed_problem(num_views=num_views, num_points=3 * num_views, reach=reach))
    one, *others = (bundle_adjust(problem, BundleOptions(threads=threads)) for threads in (1, 2, 4))
    for other in others:
        assert other.costs == one.costs
        np.testing.assert_array_equal(other.problem.points, one.problem.points)
        np.testing.assert_array_equal(other.problem.cam_from_world.R, one.problem.cam_from_world.R)
        np.testing.assert_array_equal(other.problem.cam_from_world.t, one.problem.cam_from_world.t)


def test_bundles_adjusted_at_the_same_time_do_not_disturb_each_other():
    problems = [perturbed(mixed_problem(num_views=60, num_points=150, reach=3, seed=seed)) for seed in range(4)]
    alone = [bundle_adjust(problem) for problem in problems]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda problem: bundle_adjust(problem, BundleOptions(threads=2)), problems))
    for a, b in zip(alone, together, strict=True):
        assert a.costs == b.costs
        np.testing.assert_array_equal(a.problem.points, b.problem.points)


def test_order_of_the_observations_does_not_matter():
    problem = perturbed(mixed_problem())
    order = np.random.default_rng(0).permutation(len(problem.view))
    shuffled = replace(problem, view=problem.view[order], point=problem.point[order], pixels=problem.pixels[order])
    a, b = bundle_adjust(problem), bundle_adjust(shuffled)
    np.testing.assert_array_equal(a.problem.points, b.problem.points)
    np.testing.assert_array_equal(a.usable[order], b.usable)


def test_free_gauge_reaches_the_cost_of_a_held_one_and_can_be_restored():
    problem = perturbed(without_refinement(mixed_problem(fixed=False)))
    held = bundle_adjust(replace(problem, fixed_views=np.arange(6) == 0), TIGHT)
    free = bundle_adjust(problem, replace(TIGHT, keep_gauge=True))
    assert free.final_cost == pytest.approx(held.final_cost, rel=1e-9)
    assert cost_of(free.problem) == pytest.approx(free.final_cost, rel=1e-9)
    assert_rigid3_near(free.problem.cam_from_world[0], problem.cam_from_world[0], angle=1e-12, distance=1e-12)
    before, after = (p.cam_from_world.target_origin_in_source() for p in (problem, free.problem))
    far = int(np.argmax(np.linalg.norm(before - before[0], axis=1)))
    distances = [np.linalg.norm(centers[far] - centers[0]) for centers in (before, after)]
    assert distances[1] == pytest.approx(distances[0], rel=1e-12)


def test_rotations_stay_rotations_over_many_adjustments():
    """A model that grows is adjusted hundreds of times: rounding must not add up, which it does exponentially where
    R^T stands for the inverse of an R that is not quite orthonormal."""
    problem = perturbed(without_refinement(mixed_problem(fixed=False)))
    problem = replace(problem, cam_from_world=Rigid3(1.0001 * problem.cam_from_world.R, problem.cam_from_world.t))
    for _ in range(30):
        problem = bundle_adjust(problem, BundleOptions(max_iterations=2, keep_gauge=True)).problem
    R = problem.cam_from_world.R
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)


def test_outliers_lose_to_a_robust_loss():
    problem = mixed_problem(noise_px=0.0)
    outliers = np.random.default_rng(5).choice(len(problem.view), 6, replace=False)
    problem.pixels[outliers] += 60.0
    result = bundle_adjust(perturbed(problem), replace(TIGHT, loss="cauchy"))
    errors = np.linalg.norm(reprojection_residuals(result.problem), axis=1)
    assert np.delete(errors, outliers).max() < 0.2


def test_points_behind_cameras_at_the_start_take_no_part():
    problem = mixed_problem()
    points = problem.points.copy()
    points[5] = [0.0, 0.0, -50.0]
    result = bundle_adjust(replace(problem, points=points))
    depth = problem.cam_from_world[problem.view].apply(points[problem.point])[:, 2]
    np.testing.assert_array_equal(result.usable, depth > 0)
    assert np.isfinite(result.final_cost)
    without = problem.point != 5
    alone = replace(problem, view=problem.view[without], point=problem.point[without], pixels=problem.pixels[without])
    others = np.arange(len(points)) != 5
    np.testing.assert_allclose(result.problem.points[others], bundle_adjust(alone).problem.points[others], atol=0.05)


def test_no_step_carries_a_point_behind_its_camera():
    """Pixels that can only be met from behind: the point may flee to infinity, never through the camera."""
    camera = Camera("PINHOLE", 640, 480, np.array([500.0, 500, 320, 240]))
    poses = Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [-1.0, 0, 0]]))
    points = np.array([[0.5, 0.0, 2.0]])
    # Diverging rays: they meet behind the cameras.
    problem = BundleProblem(
        cameras=(camera,),
        camera_of_view=np.zeros(2, dtype=np.int64),
        cam_from_world=poses,
        points=points,
        view=np.array([0, 1]),
        point=np.array([0, 0]),
        pixels=np.array([[300.0, 240], [340.0, 240]]),
        fixed_views=np.ones(2, dtype=bool),
        fixed_points=np.zeros(1, dtype=bool),
        refine=(np.zeros(4, dtype=bool),),
    )
    result = bundle_adjust(problem, TIGHT)
    assert np.all(result.problem.cam_from_world.apply(result.problem.points)[:, 2] > 0)
    assert result.final_cost < result.initial_cost
    assert result.final_cost == pytest.approx(0.5 * 2 * 20**2, rel=1e-2)  # parallel rays: 20 px each


def test_points_seen_once_and_far_away_do_no_harm():
    problem = mixed_problem(noise_px=0.3)
    keep = (problem.point != 7) | (np.cumsum(problem.point == 7) == 1)
    points = problem.points.copy()
    points[8] = 1e9 * (points[8] + np.array([0.0, 0.0, 5.0]))
    in_cam = problem.cam_from_world[problem.view].apply(points[problem.point])
    far = (problem.point == 8) & (in_cam[:, 2] > 0)
    pixels = problem.pixels.copy()
    for k in np.flatnonzero(far):
        camera = problem.cameras[problem.camera_of_view[problem.view[k]]]
        pixels[k] = image_from_cam(camera, in_cam[k : k + 1])[0]
    keep &= (problem.point != 8) | far
    odd = replace(problem, points=points, view=problem.view[keep], point=problem.point[keep], pixels=pixels[keep])
    result = bundle_adjust(odd, TIGHT)
    assert np.isfinite(result.problem.points).all()
    rest = (problem.point != 7) & (problem.point != 8)
    plain = replace(problem, view=problem.view[rest], point=problem.point[rest], pixels=problem.pixels[rest])
    others = (np.arange(len(points)) != 7) & (np.arange(len(points)) != 8)
    expected = bundle_adjust(plain, TIGHT).problem
    np.testing.assert_allclose(result.problem.points[others], expected.points[others], atol=2e-2)


def test_priors_pull_and_bounds_hold():
    problem = perturbed(mixed_problem(fixed=False))
    free = bundle_adjust(problem, TIGHT)
    for camera, param in ((0, 0), (1, 1)):  # in the border, and in a view's own block
        value = free.problem.cameras[camera].params[param]
        pulled = bundle_adjust(
            problem, replace(TIGHT, camera_priors=(CameraPrior(camera, param, mean=value + 50.0, sigma=1e-6),))
        )
        assert pulled.problem.cameras[camera].params[param] == pytest.approx(value + 50.0, abs=1e-3)
        weak = bundle_adjust(
            problem, replace(TIGHT, camera_priors=(CameraPrior(camera, param, mean=value + 50.0, sigma=1e9),))
        )
        assert weak.problem.cameras[camera].params[param] == pytest.approx(value, rel=1e-5)
        start = problem.cameras[camera].params[param]
        upper = max(start, value - 2.0)
        bounded = bundle_adjust(problem, replace(TIGHT, camera_priors=(CameraPrior(camera, param, upper=upper),)))
        assert bounded.problem.cameras[camera].params[param] == pytest.approx(min(upper, value), rel=1e-6)
        mask = problem.refine[camera].copy()
        mask[param] = False
        params = problem.cameras[camera].params.copy()
        params[param] = bounded.problem.cameras[camera].params[param]
        cameras = list(problem.cameras)
        cameras[camera] = replace(cameras[camera], params=params)
        refine = list(problem.refine)
        refine[camera] = mask
        held = bundle_adjust(replace(problem, cameras=tuple(cameras), refine=tuple(refine)), TIGHT)
        assert bounded.final_cost == pytest.approx(held.final_cost, rel=1e-6)


def test_priors_on_ratios_tie_two_parameters():
    """In a view's own block and in the border: the minimum has no lower neighbour, and a vague prior says nothing."""
    problem = perturbed(mixed_problem(fixed=False))
    free = bundle_adjust(problem, TIGHT).problem
    for camera in (1, 2):
        prior = CameraPrior(camera, 0, mean=3.0, sigma=1e-2, of=1, ratio=1.1)

        def cost(at: BundleProblem, camera: int = camera) -> float:
            fx, fy = at.cameras[camera].params[:2]
            return cost_of(at) + 0.5 * ((fx - 1.1 * fy - 3.0) / 1e-2) ** 2

        tied = bundle_adjust(problem, replace(TIGHT, camera_priors=(prior,)))
        params = tied.problem.cameras[camera].params
        assert params[0] == pytest.approx(1.1 * params[1] + 3.0, abs=0.05)
        assert tied.final_cost == pytest.approx(cost(tied.problem), rel=1e-9)
        for step in ([1.1, 1.0], [-1.1, -1.0], [1.0, 0.0], [0.0, 1.0]):
            moved = list(tied.problem.cameras)
            moved[camera] = replace(moved[camera], params=params + 1e-2 * np.pad(step, (0, len(params) - 2)))
            assert cost(replace(tied.problem, cameras=tuple(moved))) > tied.final_cost
        vague = bundle_adjust(problem, replace(TIGHT, camera_priors=(replace(prior, sigma=1e9),))).problem
        np.testing.assert_allclose(vague.cameras[camera].params, free.cameras[camera].params, rtol=1e-5)


def test_a_prior_on_a_ratio_leaves_a_parameter_at_its_bound_there():
    problem = perturbed(mixed_problem(fixed=False))
    for camera in (1, 2):
        start = problem.cameras[camera].params
        upper = float(start[0])
        options = replace(TIGHT, camera_priors=(
            CameraPrior(camera, 0, mean=100.0, sigma=1e-2, upper=upper, of=1), CameraPrior(camera, 1, lower=start[1])
        ))  # fmt: skip
        found = bundle_adjust(problem, options).problem.cameras[camera].params
        assert found[0] == pytest.approx(upper, abs=1e-9)
        assert found[1] == pytest.approx(start[1], abs=1e-6)


def test_prior_is_part_of_the_cost():
    problem = mixed_problem()
    prior = CameraPrior(0, 0, mean=problem.cameras[0].params[0] + 10.0, sigma=2.0)
    result = bundle_adjust(problem, BundleOptions(max_iterations=0, camera_priors=(prior,)))
    assert result.initial_cost == pytest.approx(cost_of(problem) + 0.5 * 25.0, rel=1e-12)
    assert result.reason == "iteration limit"


@pytest.mark.parametrize(
    "options",
    [
        {"loss_scale_px": 0.0},
        {"relative_tolerance": 1.0},
        {"max_iterations": -1},
        {"threads": 0},
        {"initial_damping": 0.0},
    ],
)
def test_bad_options_are_refused(options):
    with pytest.raises(ValueError):
        BundleOptions(**options)


def test_bad_priors_are_refused():
    problem = mixed_problem()
    for prior, message in (
        (CameraPrior(9, 0), "camera 9"),
        (CameraPrior(0, 9), "parameter 9"),
        (CameraPrior(0, 0, lower=1e6), "outside its bounds"),
    ):
        with pytest.raises(ValueError, match=message):
            bundle_adjust(problem, BundleOptions(camera_priors=(prior,)))
    with pytest.raises(ValueError, match="sigma"):
        CameraPrior(0, 0, sigma=0.0)
    with pytest.raises(ValueError, match="empty"):
        CameraPrior(0, 0, lower=1.0, upper=0.0)


def test_nothing_to_refine_is_a_no_op():
    problem = without_refinement(mixed_problem())
    held = replace(problem, fixed_views=np.ones(6, dtype=bool), fixed_points=np.ones(30, dtype=bool))
    result = bundle_adjust(held)
    assert result.problem is held
    assert result.reason == "nothing to refine"


def test_published_problem_reaches_the_best_known_cost():
    problem = read_bal(data_folder("bal") / "problem-21-11315-pre.txt")
    result = bundle_adjust(problem)
    assert result.initial_cost == pytest.approx(4.413239e6, rel=1e-6)
    assert result.final_cost <= 30378.64 * 1.0001
