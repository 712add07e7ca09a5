import numpy as np
import pytest
from scipy.integrate import quad

from fieldstone.synthetic.analytic_field import Ball, GaussianBlob, Slab

FIELDS = [
    Slab(1.7, np.array([0.6, 0.0, 0.8]), -0.3, 0.5),
    Ball(2.3, np.array([0.1, -0.2, 0.3]), 0.8),
    GaussianBlob(3.1, np.array([-0.2, 0.1, 0.2]), 0.4),
]


def random_rays(seed, n):
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((n, 3))
    return rng.uniform(-1.5, 1.5, (n, 3)), directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("field", FIELDS, ids=lambda f: type(f).__name__)
def test_optical_depth_is_the_integral_of_the_density(field):
    origins, directions = random_rays(0, 40)
    t0, t1 = 0.2, 3.0
    depth = field.optical_depth(origins, directions, t0, t1)
    t = t0 + (np.arange(40_000) + 0.5) * (t1 - t0) / 40_000
    points = origins[:, None] + t[:, None] * directions[:, None]
    midpoint_rule = field.density(points).sum(axis=1) * (t1 - t0) / 40_000
    # At most one step at each of the two boundaries.
    np.testing.assert_allclose(depth, midpoint_rule, atol=2 * field.sigma * (t1 - t0) / 40_000)
    assert np.count_nonzero(depth) >= 5


def test_gaussian_against_adaptive_quadrature():
    field = FIELDS[2]
    origins, directions = random_rays(1, 10)
    depth = field.optical_depth(origins, directions, 0.1, 2.0)
    for origin, direction, value in zip(origins, directions, depth, strict=True):
        expected, _ = quad(
            lambda t, o=origin, d=direction: float(field.density((o + t * d)[None])[0]), 0.1, 2.0, epsabs=1e-12
        )
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("field", FIELDS, ids=lambda f: type(f).__name__)
def test_optical_depth_adds_up(field):
    origins, directions = random_rays(2, 30)
    parts = field.optical_depth(origins, directions, 0.0, 1.1) + field.optical_depth(origins, directions, 1.1, 4.0)
    np.testing.assert_allclose(field.optical_depth(origins, directions, 0.0, 4.0), parts, rtol=1e-9, atol=1e-12)


def test_slab_along_the_ray():
    slab = Slab(2.0, np.array([0.0, 0.0, 1.0]), -1.0, 1.0)
    origins = np.array([[0.0, 0, 0], [0.0, 0, 1.5], [0.0, 0, -3.0]])
    directions = np.array([[1.0, 0, 0], [1.0, 0, 0], [0.0, 0, 1.0]])
    np.testing.assert_allclose(slab.optical_depth(origins, directions, 0.5, 3.5), [6.0, 0.0, 3.0])
