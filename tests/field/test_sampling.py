import numpy as np
import pytest

from fieldstone.field.nerf.sampling import PDF_FLOOR, hierarchical, inverse_cdf, stratified


def test_stratified_midpoints_are_equally_spaced():
    t = stratified(2.0, 6.0, np.full((3, 8), 0.5))
    np.testing.assert_allclose(t, np.broadcast_to(2.25 + 0.5 * np.arange(8), (3, 8)), rtol=1e-12)


def test_stratified_samples_stay_in_their_bins_and_are_uniform():
    noise = np.random.default_rng(0).random((20_000, 8))
    t = stratified(2.0, 6.0, noise)
    bins = 2.0 + 0.5 * np.arange(9)
    assert np.all(t >= bins[:-1])
    assert np.all(t < bins[1:])
    # Moments of the uniform distribution on a bin of width 1/2: variance 1/48, fourth moment about the mean 1/1280.
    centered = t - (bins[:-1] + 0.25)
    standard_error = np.sqrt(1 / 48 / 20_000)
    assert np.all(np.abs(centered.mean(axis=0)) < 5 * standard_error)
    error_of_variance = np.sqrt((1 / 1280 - (1 / 48) ** 2) / 20_000)
    assert np.all(np.abs((centered**2).mean(axis=0) - 1 / 48) < 5 * error_of_variance)


def test_stratified_integral_has_no_bias_and_less_variance_than_plain_monte_carlo():
    # Integral of t^2 over [2, 6] = 208 / 3.
    noise = np.random.default_rng(1).random((20_000, 8))
    estimates = 4.0 * np.mean(stratified(2.0, 6.0, noise) ** 2, axis=1)
    standard_error = estimates.std() / np.sqrt(len(estimates))
    assert abs(estimates.mean() - 208 / 3) < 5 * standard_error
    plain = 4.0 * np.mean((2.0 + 4.0 * noise) ** 2, axis=1)
    # Smooth integrands: variance falls by the square of the number of strata.
    assert estimates.var() < plain.var() / 40


def test_inverse_cdf_of_equal_weights_is_linear():
    u = np.linspace(0, 0.999, 50)[None]
    t = inverse_cdf(np.linspace(2, 6, 9)[None], np.full((1, 8), 0.1), u)
    np.testing.assert_allclose(t, 2 + 4 * u, rtol=1e-12)


def test_inverse_cdf_of_two_intervals():
    # Probability 3/4 on [0, 1] and 1/4 on [1, 5]: u = 3/8 is the middle of the first, u = 7/8 of the second.
    weights = np.array([[3.0, 1.0]]) * 1e6
    t = inverse_cdf(np.array([[0.0, 1.0, 5.0]]), weights, np.array([[0.0, 3 / 8, 3 / 4, 7 / 8]]))
    np.testing.assert_allclose(t, [[0.0, 0.5, 1.0, 3.0]], atol=1e-9)


def test_inverse_cdf_inverts_the_cdf():
    rng = np.random.default_rng(2)
    edges = np.sort(rng.uniform(0, 10, (6, 13)), axis=1)
    weights = rng.exponential(size=(6, 12)) * (rng.random((6, 12)) < 0.7)
    u = rng.random((6, 40))
    t = inverse_cdf(edges, weights, u)
    probability = (weights + PDF_FLOOR) / np.sum(weights + PDF_FLOOR, axis=1, keepdims=True)
    for ray in range(6):
        cdf = np.concatenate([[0.0], np.cumsum(probability[ray])])
        np.testing.assert_allclose(np.interp(t[ray], edges[ray], cdf), u[ray], atol=1e-9)


def test_empty_rays_are_sampled_everywhere():
    t = inverse_cdf(np.linspace(2, 6, 5)[None], np.zeros((1, 4)), np.array([[0.0, 0.25, 0.5, 0.999]]))
    np.testing.assert_allclose(t, [[2.0, 3.0, 4.0, 2 + 4 * 0.999]], rtol=1e-9)


def test_hierarchical_samples_follow_the_weights():
    rng = np.random.default_rng(3)
    weights = np.array([0.0, 0.1, 0.6, 0.3])
    t = np.broadcast_to([0.5, 1.0, 3.0, 4.0], (4000, 4)).copy()
    out = hierarchical(t, np.broadcast_to(weights, (4000, 4)).copy(), 6.0, rng.random((4000, 32)))
    assert out.shape == (4000, 36)
    assert np.all(np.diff(out, axis=1) >= 0)
    assert all(np.all(np.any(out == value, axis=1)) for value in (0.5, 1.0, 3.0, 4.0))
    share = [np.mean((out > a) & (out < b)) * 36 / 32 for a, b in [(0.5, 1), (1, 3), (3, 4), (4, 6)]]
    # Stratified: the count of each ray in an interval differs from its share by less than two of 32.
    np.testing.assert_allclose(share, weights, atol=2 / 32 / np.sqrt(4000) * 5)


@pytest.mark.parametrize("num_new", [1, 7])
def test_hierarchical_midpoints_are_deterministic(num_new):
    t = np.array([[1.0, 2.0]])
    out = hierarchical(t, np.array([[1e6, 1e6]]), 3.0, np.full((1, num_new), 0.5))
    expected = np.sort(np.concatenate([[1.0, 2.0], 1 + 2 * (np.arange(num_new) + 0.5) / num_new]))
    np.testing.assert_allclose(out, expected[None], rtol=1e-9)
