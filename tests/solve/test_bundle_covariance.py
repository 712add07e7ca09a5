from dataclasses import replace

import numpy as np
import pytest

from bundle_worlds import mixed_problem, without_refinement
from fieldstone.geometry.rotation import log
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.covariance import bundle_covariance
from fieldstone.solve.bundle.schur import normal_equations
from fieldstone.solve.robust.loss import trivial


def held_problem():
    return replace(mixed_problem(), fixed_views=np.isin(np.arange(6), (0, 4)))


def test_held_gauge_is_the_inverse_of_the_whole_system():
    problem = held_problem()
    covariance = bundle_covariance(problem, sigma_px=0.5)
    assert covariance.gauge == "held"
    equations = normal_equations(problem, trivial(), np.zeros(3))
    free = equations.free
    whole = np.zeros_like(equations.H)
    whole[np.ix_(free, free)] = 0.25 * np.linalg.inv(equations.H[np.ix_(free, free)])
    for i in range(6):
        np.testing.assert_allclose(
            covariance.of_views[i], whole[6 * i : 6 * i + 6, 6 * i : 6 * i + 6], rtol=1e-6, atol=1e-15
        )
    for c, block in enumerate(covariance.of_cameras):
        k, first = len(block), 36 + 8 * c
        np.testing.assert_allclose(block, whole[first : first + k, first : first + k], rtol=1e-6, atol=1e-15)
    for j in range(len(problem.points)):
        first = equations.num_camera_columns + 3 * j
        np.testing.assert_allclose(
            covariance.of_points[j], whole[first : first + 3, first : first + 3], rtol=1e-6, atol=1e-15
        )


def test_predicts_the_scatter_of_repeated_adjustments():
    truth = without_refinement(replace(mixed_problem(noise_px=0.0), fixed_views=np.arange(6) < 2))
    covariance = bundle_covariance(truth, sigma_px=0.4)
    rng = np.random.default_rng(4)
    draws = 200
    points, omegas = np.empty((draws, 3)), np.empty((draws, 3))
    for k in range(draws):
        noisy = replace(truth, pixels=truth.pixels + 0.4 * rng.normal(size=truth.pixels.shape))
        found = bundle_adjust(noisy, BundleOptions(relative_tolerance=1e-9)).problem
        points[k] = found.points[5]
        omegas[k] = log(truth.cam_from_world.R[3].T @ found.cam_from_world.R[3])
    for scatter, expected in (
        (points, covariance.of_points[5]),
        (omegas, covariance.of_views[3, :3, :3]),
    ):
        ratio = np.var(scatter, axis=0, ddof=1) / np.diag(expected)
        assert np.all(np.abs(ratio - 1) < 5 * np.sqrt(2 / draws))


def test_free_gauge_gives_the_same_for_what_the_gauge_cannot_change():
    """Intrinsics do not feel the gauge: held and inner gauge agree on them."""
    free = mixed_problem(fixed=False)
    inner = bundle_covariance(free)
    assert inner.gauge == "inner"
    equations = normal_equations(free, trivial(), np.zeros(3))
    use = equations.free.copy()
    use[:6] = False
    use[6 + 3] = False  # the first view and a coordinate of the second: the minimal seven
    whole = np.zeros_like(equations.H)
    whole[np.ix_(use, use)] = np.linalg.inv(equations.H[np.ix_(use, use)])
    for c, block in enumerate(inner.of_cameras):
        k, first = len(block), 36 + 8 * c
        np.testing.assert_allclose(block, whole[first : first + k, first : first + k], rtol=1e-5, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(inner.of_views) > 0)


def test_undetermined_points_are_nan_and_undetermined_views_are_refused():
    problem = held_problem()
    once = (problem.point != 7) | (np.cumsum(problem.point == 7) == 1)
    single = replace(problem, view=problem.view[once], point=problem.point[once], pixels=problem.pixels[once])
    covariance = bundle_covariance(single)
    assert np.all(np.isnan(covariance.of_points[7]))
    assert np.all(np.isfinite(np.delete(covariance.of_points, 7, axis=0)))
    few = (problem.view != 3) | (np.cumsum(problem.view == 3) <= 2)
    with pytest.raises(ValueError, match="not determined"):
        bundle_covariance(
            without_refinement(
                replace(problem, view=problem.view[few], point=problem.point[few], pixels=problem.pixels[few])
            )
        )
