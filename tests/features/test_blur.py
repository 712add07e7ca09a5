import numpy as np
import pytest
from scipy.ndimage import correlate1d

from fieldstone.features.blur_numba import blur_row_numba, blurred_numba, gaussian_weights, mirrored_numba


@pytest.mark.parametrize("sigma", [0.3, 1.2, 1.55, 3.1])
def test_weights_are_of_a_gaussian_out_to_nearly_four_standard_deviations(sigma):
    weights = gaussian_weights(sigma).astype(np.float64)
    radius = len(weights) - 1
    assert radius % 4 == 2
    assert radius >= 4 * sigma - 1
    np.testing.assert_allclose(weights[0] + 2 * weights[1:].sum(), 1.0, rtol=1e-6)
    np.testing.assert_allclose(weights[1] / weights[0], np.exp(-1 / (2 * sigma**2)), rtol=1e-6)
    if sigma > 1.0:
        np.testing.assert_allclose(2 * np.sum(weights * np.arange(radius + 1) ** 2), sigma**2, rtol=5e-3)


@pytest.mark.parametrize(("k", "n", "seen"), [(0, 5, 0), (4, 5, 4), (5, 5, 3), (-1, 5, 1), (-9, 5, 1), (7, 1, 0)])
def test_mirrors_stand_at_the_centres_of_the_outer_pixels(k, n, seen):
    assert mirrored_numba(k, n) == mirrored_numba.py_func(k, n) == seen


@pytest.mark.parametrize("shape", [(40, 70), (13, 5), (1, 9), (9, 1), (2, 3)])
@pytest.mark.parametrize("sigma", [1.2, 2.4, 3.1])
def test_blur_is_a_convolution_along_either_axis(shape, sigma):
    image = np.random.default_rng(0).uniform(0, 255, shape).astype(np.float32)
    weights = gaussian_weights(sigma)
    kernel = np.concatenate([weights[:0:-1], weights]).astype(np.float64)
    expected = correlate1d(correlate1d(image.astype(np.float64), kernel, axis=0, mode="mirror"), kernel, mode="mirror")
    np.testing.assert_allclose(blurred_numba(image, weights), expected, rtol=1e-4, atol=1e-5 * 255)


def test_the_last_rows_of_an_image_are_enough():
    image = np.random.default_rng(1).uniform(0, 255, (50, 20)).astype(np.float32)
    weights = gaussian_weights(1.2)
    ring, line = np.empty((16, 20), dtype=np.float32), np.empty(20 + 2 * len(weights), dtype=np.float32)
    found = np.empty_like(image)
    for y in range(50 + 6):
        if y < 50:
            ring[y % 16] = image[y]
        if y >= 6:
            blur_row_numba(ring, found, y - 6, 50, weights, line)
    np.testing.assert_array_equal(found, blurred_numba(image, weights))
