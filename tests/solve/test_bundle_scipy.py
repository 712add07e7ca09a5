from dataclasses import replace

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_jacobian, reprojection_residuals, updated
from fieldstone.solve.bundle.scipy_reference import bundle_adjust_scipy
from fieldstone.solve.robust.loss import cauchy, huber, robustify, soft_l1, trivial
from matchers import check_jacobian


def ring_problem(noise_px: float, *, num_views: int = 4, num_points: int = 25, seed: int = 0) -> BundleProblem:
    """Two camera models, cameras around a cloud; pixels with Gaussian noise around the truth."""
    rng = np.random.default_rng(seed)
    cameras = (
        Camera("SIMPLE_RADIAL", 800, 600, np.array([700.0, 400, 300, -0.05])),
        Camera("PINHOLE", 640, 480, np.array([500.0, 510, 320, 240])),
    )
    angles = np.linspace(0, 1.5, num_views)
    R = exp(np.stack([np.zeros(num_views), angles, np.zeros(num_views)], axis=1))
    poses = Rigid3(R, np.tile([0.0, 0.0, 6.0], (num_views, 1)))
    points = rng.uniform(-1, 1, size=(num_points, 3))
    view, point = np.divmod(np.arange(num_views * num_points), num_points)
    camera_of_view = np.arange(num_views) % 2
    pixels = np.empty((len(view), 2))
    for k, (i, j) in enumerate(zip(view, point, strict=True)):
        pixels[k] = image_from_cam(cameras[camera_of_view[i]], poses[i].apply(points[j : j + 1]))[0]
    return BundleProblem(
        cameras=cameras,
        camera_of_view=camera_of_view,
        cam_from_world=poses,
        points=points,
        view=view,
        point=point,
        pixels=pixels + noise_px * rng.normal(size=pixels.shape),
        fixed_views=np.arange(num_views) == 0,
        fixed_points=np.arange(num_points) == 3,
        refine=(np.array([True, False, False, True]), np.zeros(4, dtype=bool)),
    )


def perturbed(problem: BundleProblem, seed: int = 1) -> BundleProblem:
    rng = np.random.default_rng(seed)
    return updated(
        problem,
        0.02 * rng.normal(size=(problem.num_views, 6)) * ~problem.fixed_views[:, None],
        0.05 * rng.normal(size=problem.points.shape) * ~problem.fixed_points[:, None],
        tuple(20 * rng.normal() * mask * (np.arange(len(mask)) == 0) for mask in problem.refine),
    )


def test_jacobian_blocks_match_central_differences():
    problem = replace(perturbed(ring_problem(1.0, num_points=4)), pixel_scale=np.array([1.0, 0.5, 3.0, 2.0]))
    residuals, J = reprojection_jacobian(problem)
    np.testing.assert_array_equal(residuals, reprojection_residuals(problem))
    rows = np.arange(len(residuals))

    def moved(poses=None, points=None, cameras=None):
        return reprojection_residuals(
            updated(
                problem,
                np.zeros((problem.num_views, 6)) if poses is None else poses,
                np.zeros_like(problem.points) if points is None else points,
                tuple(np.zeros(4) for _ in range(2)) if cameras is None else cameras,
            )
        )

    check_jacobian(lambda d: moved(poses=np.tile(d, (problem.num_views, 1)))[rows], J.by_pose, size=6)
    check_jacobian(lambda d: moved(points=np.tile(d, (4, 1)))[rows], J.by_point, size=3)
    check_jacobian(lambda d: moved(cameras=(d, d))[rows], J.by_camera, size=4)


@pytest.mark.parametrize("loss", [trivial(), huber(1.5), soft_l1(1.5), cauchy(1.5)])
def test_robust_losses_and_their_derivatives(loss):
    r = np.random.default_rng(0).normal(size=(30, 2)) * np.geomspace(1e-6, 1e3, 30)[:, None]
    r[0] = 0.0
    f, derivative = robustify(loss, r)
    rho, weight = loss(np.sum(r**2, axis=1))
    np.testing.assert_allclose(np.sum(f**2, axis=1), rho, rtol=1e-12)
    check_jacobian(lambda d: robustify(loss, r[1:] + d)[0], derivative[1:], size=2, rtol=1e-5)
    s = np.sum(r[1:] ** 2, axis=1)
    numeric = (loss(s * 1.0001)[0] - loss(s * 0.9999)[0]) / (0.0002 * s)
    np.testing.assert_allclose(weight[1:], numeric, rtol=1e-3)


def test_exact_data_is_recovered_from_a_perturbed_start():
    truth = ring_problem(0.0)
    result = bundle_adjust_scipy(perturbed(truth), relative_tolerance=1e-14)
    assert result.final_cost < 1e-12 * result.initial_cost
    np.testing.assert_allclose(result.problem.points, truth.points, atol=1e-6)
    np.testing.assert_allclose(result.problem.cameras[0].params, truth.cameras[0].params, atol=1e-4)
    np.testing.assert_array_equal(result.problem.cam_from_world.R[0], truth.cam_from_world.R[0])
    np.testing.assert_array_equal(result.problem.points[3], truth.points[3])


def test_noisy_minimum_has_no_gradient_and_the_residual_of_the_noise():
    result = bundle_adjust_scipy(perturbed(ring_problem(0.7)), relative_tolerance=1e-14)
    r, J = reprojection_jacobian(result.problem)
    by_point = np.zeros((25, 3))
    np.add.at(by_point, result.problem.point, np.einsum("oij,oi->oj", J.by_point, r))
    by_pose = np.zeros((4, 6))
    np.add.at(by_pose, result.problem.view, np.einsum("oij,oi->oj", J.by_pose, r))
    scale = np.linalg.norm(r) * np.linalg.norm(J.by_point, axis=(1, 2)).max()
    assert np.abs(by_point[np.arange(25) != 3]).max() < 1e-4 * scale
    assert np.abs(by_pose[1:]).max() < 1e-4 * scale
    degrees_of_freedom = r.size - 3 * 6 - 24 * 3 - 2
    rms = np.sqrt(2 * result.final_cost / degrees_of_freedom)
    assert abs(rms - 0.7) < 5 * 0.7 / np.sqrt(2 * degrees_of_freedom)


def test_robust_loss_ignores_outliers():
    problem = ring_problem(0.0)
    outliers = np.random.default_rng(5).choice(len(problem.view), 5, replace=False)
    problem.pixels[outliers] += 80.0
    result = bundle_adjust_scipy(perturbed(problem), loss=cauchy(1.0), max_evaluations=300)
    errors = np.linalg.norm(reprojection_residuals(result.problem), axis=1)
    inliers = np.setdiff1d(np.arange(len(errors)), outliers)
    assert errors[inliers].max() < 0.05


def test_points_behind_a_camera_are_refused_and_nothing_free_is_a_no_op():
    problem = ring_problem(0.0)
    points = problem.points.copy()
    points[5] = [0, 0, -50]
    with pytest.raises(ValueError, match="behind"):
        bundle_adjust_scipy(replace(problem, points=points))
    fixed = replace(
        problem,
        fixed_views=np.ones(4, dtype=bool),
        fixed_points=np.ones(25, dtype=bool),
        refine=(np.zeros(4, dtype=bool),) * 2,
    )
    assert bundle_adjust_scipy(fixed).problem is fixed
