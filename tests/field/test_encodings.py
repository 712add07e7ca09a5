import numpy as np
import pytest

from fieldstone.field.nerf.encodings import encoded_size, frequency_encoding


def test_values_of_the_definition():
    x = np.array([0.3, -1.2, 0.7])
    encoded = frequency_encoding(x, 2)
    expected = np.concatenate([x, np.sin(x), np.sin(2 * x), np.cos(x), np.cos(2 * x)])
    np.testing.assert_allclose(encoded, expected, rtol=1e-12)


@pytest.mark.parametrize("num_frequencies", [0, 1, 6])
def test_laws_of_sine_and_cosine(num_frequencies):
    x = np.random.default_rng(0).uniform(-2, 2, (5, 7, 3))
    encoded = frequency_encoding(x, num_frequencies)
    assert encoded.shape == (5, 7, encoded_size(num_frequencies))
    np.testing.assert_array_equal(encoded[..., :3], x)
    sine, cosine = np.split(encoded[..., 3:].reshape(5, 7, 2 * num_frequencies, 3), 2, axis=2)
    np.testing.assert_allclose(sine**2 + cosine**2, 1.0, rtol=1e-12)
    # Each octave is the double angle of the one before.
    np.testing.assert_allclose(sine[..., 1:, :], (2 * sine * cosine)[..., :-1, :], atol=1e-12)
    np.testing.assert_allclose(cosine[..., 1:, :], (2 * cosine**2 - 1)[..., :-1, :], atol=1e-12)


def test_inner_products_depend_on_the_distance_alone():
    # sum_k cos(2^k (x - y)): the stationarity that makes the encoding useful.
    rng = np.random.default_rng(1)
    x, y, shift = rng.uniform(-1, 1, (3, 3))
    waves = [frequency_encoding(p, 5)[3:] for p in (x, y, x + shift, y + shift)]
    kernel = np.sum(np.cos(2.0 ** np.arange(5)[:, None] * (x - y)))
    assert waves[0] @ waves[1] == pytest.approx(kernel, rel=1e-9)
    assert waves[2] @ waves[3] == pytest.approx(kernel, rel=1e-9)
