from dataclasses import replace

import numpy as np
import pytest

from bundle_worlds import mixed_problem
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.camera_prior import CameraPrior
from fieldstone.solve.bundle.covariance import bundle_covariance
from fieldstone.solve.bundle.intrinsics_covariance import intrinsics_covariance
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.robust.loss import trivial

TIGHT = BundleOptions(relative_tolerance=1e-10)


@pytest.mark.parametrize("fixed", [True, False])
def test_by_noise_it_is_the_block_of_the_whole_covariance(fixed):
    """Cameras of one photo and shared ones, in a held gauge and in a free one."""
    problem = mixed_problem(fixed=fixed)
    options = BundleOptions(camera_priors=(CameraPrior(2, 0, mean=500.0, sigma=1.0, of=1),))
    found = intrinsics_covariance(problem, options, trivial(), sigma_px=0.5)
    whole = bundle_covariance(problem, options, sigma_px=0.5)
    for c, block in enumerate(whole.of_cameras):
        mine = np.flatnonzero(found.camera == c)
        assert found.param[mine].tolist() == np.flatnonzero(problem.refine[c]).tolist()
        np.testing.assert_allclose(
            found.by_noise[np.ix_(mine, mine)], block[np.ix_(found.param[mine], found.param[mine])], rtol=1e-5
        )


def ring(pixels_of, rng: np.random.Generator, num_views: int = 12, num_points: int = 80) -> BundleProblem:
    """Photos of a cloud all around it, by one camera without distortion; `pixels_of(pixels, view, point)` spoils them.

    The focal length and a radial term are free.
    """
    camera = Camera("SIMPLE_RADIAL", 800, 600, np.array([700.0, 400.0, 300.0, 0.0]))
    angles = 2 * np.pi * np.arange(num_views) / num_views
    centers = np.stack([4 * np.cos(angles), 4 * np.sin(angles), 0.5 * np.cos(3 * angles)], axis=1)
    poses = Rigid3.stack([look_at(center, np.zeros(3), np.array([0.0, 0.0, 1.0])) for center in centers])
    points = rng.uniform(-1, 1, size=(num_points, 3))
    view, point = (index.ravel() for index in np.indices((num_views, num_points)))
    pixels = image_from_cam(camera, poses[view].apply(points[point]))
    return BundleProblem(
        cameras=(camera,),
        camera_of_view=np.zeros(num_views, dtype=np.int64),
        cam_from_world=poses,
        points=points,
        view=view,
        point=point,
        pixels=pixels_of(pixels, view, point),
        fixed_views=np.zeros(num_views, dtype=bool),
        fixed_points=np.zeros(num_points, dtype=bool),
        refine=(np.array([True, False, False, True]),),
    )


def scatter_and_promises(spoil, draws: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of (f, k) over many problems, and the mean variances promised by noise and by clusters."""
    errors, by_noise, by_clusters = np.empty((draws, 2)), np.empty((draws, 2)), np.empty((draws, 2))
    for k in range(draws):
        rng = np.random.default_rng(k)
        problem = ring(lambda pixels, view, point, rng=rng: spoil(pixels, view, point, rng), rng)
        found = bundle_adjust(problem, TIGHT)
        errors[k] = found.problem.cameras[0].params[[0, 3]] - [700.0, 0.0]
        freedoms = 2 * len(problem.view) - 6 * 12 - 3 * 80 + 7 - 2
        sigma = np.sqrt(2.0 * found.final_cost / freedoms)
        covariance = intrinsics_covariance(found.problem, TIGHT, trivial(), sigma_px=float(sigma))
        by_noise[k], by_clusters[k] = np.diag(covariance.by_noise), np.diag(covariance.by_clusters)
    return np.var(errors, axis=0), by_noise.mean(axis=0), by_clusters.mean(axis=0)


def test_independent_errors_scatter_as_both_say():
    """60 draws tell a variance to 18 % (one standard deviation), 12 clusters in each of them its promise to 5 %."""
    scatter, by_noise, by_clusters = scatter_and_promises(lambda p, v, x, rng: p + 0.5 * rng.normal(size=p.shape))
    np.testing.assert_allclose(by_noise, scatter, rtol=0.6)
    np.testing.assert_allclose(by_clusters, by_noise, rtol=0.35)


def test_errors_that_photos_have_in_common_scatter_as_clusters_say():
    """Every photo has a radial distortion of its own, about 0: the lens model knows of one for all."""

    def spoil(pixels, view, point, rng):
        k = 0.02 * rng.normal(size=12)[view]
        offset = pixels - [400.0, 300.0]
        r2 = np.sum((offset / 700.0) ** 2, axis=1)
        return pixels + (k * r2)[:, None] * offset + 0.1 * rng.normal(size=pixels.shape)

    scatter, by_noise, by_clusters = scatter_and_promises(spoil)
    assert by_noise[1] < 0.2 * scatter[1]
    np.testing.assert_allclose(by_clusters, scatter, rtol=0.6)


def test_what_is_held_has_no_row():
    problem = mixed_problem()
    held = replace(problem, refine=(problem.refine[0], np.zeros(8, dtype=bool), problem.refine[2]))
    assert set(intrinsics_covariance(held, BundleOptions(), trivial()).camera.tolist()) == {0, 2}
