import numpy as np
import pytest

from fieldstone.field.base.volume_rendering import composite, interval_lengths, ray_weights
from fieldstone.field.nerf.sampling import stratified
from fieldstone.synthetic.analytic_field import Ball, GaussianBlob, Slab

NEAR, FAR = 2.0, 6.0
BACKGROUND = np.array([0.2, 0.4, 1.0])


def rays_towards_the_origin(n, seed=0):
    """From distance 4 to points near the origin."""
    rng = np.random.default_rng(seed)
    origins = rng.standard_normal((n, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.3, 0.3, (n, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def render(field, origins, directions, t, color=(1.0, 0.5, 0.0)):
    points = origins[:, None] + t[..., None] * directions[:, None]
    colors = np.broadcast_to(color, points.shape)
    return composite(field.density(points), colors, t, far=FAR, background=BACKGROUND)


def test_slab_on_sample_boundaries_is_exact():
    # The slab fills whole intervals: opacity 1 - exp(-sigma length), whatever the number of samples in it.
    t = np.concatenate([np.linspace(2, 3, 5)[:-1], np.linspace(3, 4.5, 9)[:-1], np.linspace(4.5, 6, 4)[:-1]])[None]
    density = np.where((t >= 3) & (t < 4.5), 0.8, 0.0)
    out = composite(density, np.ones((*t.shape, 3)) * [1.0, 0.5, 0.0], t, far=FAR, background=BACKGROUND)
    passed = np.exp(-0.8 * 1.5)
    np.testing.assert_allclose(out.opacity, 1 - passed, rtol=1e-12)
    np.testing.assert_allclose(out.rgb, [(1 - passed) * np.array([1.0, 0.5, 0.0]) + passed * BACKGROUND], rtol=1e-12)


def test_weights_telescope_to_the_opacity():
    tau = np.random.default_rng(0).exponential(size=(50, 20)) * np.geomspace(1e-12, 3, 50)[:, None]
    weights = ray_weights(tau)
    np.testing.assert_allclose(weights.sum(axis=1), -np.expm1(-tau.sum(axis=1)), rtol=1e-12)
    assert np.all(weights >= 0)


def test_intervals_cover_the_ray_from_the_first_sample_to_far():
    t = np.sort(np.random.default_rng(1).uniform(NEAR, FAR, (5, 9)), axis=1)
    np.testing.assert_allclose(interval_lengths(t, FAR).sum(axis=1), FAR - t[:, 0], rtol=1e-12)


def test_depth_in_a_homogeneous_medium_is_that_of_the_exponential_law():
    # E[min(t, far)] of a light path that starts at near: near + (1 - exp(-sigma L)) / sigma.
    sigma, n = 0.7, 20_000
    t = (NEAR + (FAR - NEAR) * np.arange(n) / n)[None]
    out = composite(np.full((1, n), sigma), np.zeros((1, n, 3)), t, far=FAR, background=BACKGROUND)
    expected = NEAR + (1 - np.exp(-sigma * (FAR - NEAR))) / sigma
    # Left ends stand for the intervals: too near by at most one interval.
    assert expected - (FAR - NEAR) / n < out.depth[0] <= expected


@pytest.mark.parametrize(
    "field",
    [
        Slab(1.1, np.array([0.0, 0.6, 0.8]), -0.4, 0.5),
        Ball(0.9, np.zeros(3), 1.1),
        GaussianBlob(1.3, np.array([0.1, 0.0, -0.1]), 0.4),
    ],
    ids=lambda f: type(f).__name__,
)
def test_opacity_converges_to_the_closed_form(field):
    origins, directions = rays_towards_the_origin(200)
    expected = -np.expm1(-field.optical_depth(origins, directions, NEAR, FAR))
    errors = []
    for num_samples in (64, 1024):
        t = stratified(NEAR, FAR, np.full((200, num_samples), 0.5))
        out = render(field, origins, directions, t)
        errors.append(np.abs(out.opacity - expected).mean())
        # A boundary is missed by at most one interval; there are two of them.
        assert np.abs(out.opacity - expected).max() <= 2 * field.sigma * (FAR - NEAR) / num_samples
        np.testing.assert_allclose(
            out.rgb, out.opacity[:, None] * [1.0, 0.5, 0.0] + (1 - out.opacity[:, None]) * BACKGROUND, rtol=1e-9
        )
    assert errors[1] < errors[0] / 8  # 16 times the samples


def test_two_slabs_mix_in_the_order_of_the_light():
    # Red in front of blue: red 1 - exp(-a), blue exp(-a) (1 - exp(-b)), background exp(-a - b).
    t = np.array([[2.0, 3.0, 4.0, 5.0]])
    density = np.array([[0.0, 0.9, 1.4, 0.0]])
    color = np.array([[[0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0]]], dtype=float)
    out = composite(density, color, t, far=FAR, background=np.zeros(3))
    np.testing.assert_allclose(out.rgb, [[1 - np.exp(-0.9), 0, np.exp(-0.9) * (1 - np.exp(-1.4))]], rtol=1e-12)


def test_empty_space_shows_the_background():
    t = np.sort(np.random.default_rng(2).uniform(NEAR, FAR, (3, 6)), axis=1)
    out = composite(np.zeros((3, 6)), np.ones((3, 6, 3)), t, far=FAR, background=BACKGROUND)
    np.testing.assert_array_equal(out.rgb, np.broadcast_to(BACKGROUND, (3, 3)))
    np.testing.assert_array_equal(out.depth, np.full(3, FAR))
    np.testing.assert_array_equal(out.opacity, np.zeros(3))
