import numpy as np
import pytest

from fieldstone.evaluate.image_metrics import mean_squared_error, psnr, quantize, ssim


def brute_force_ssim(a, b):
    """The definition, window by window: Gaussian weights, population moments, K1 0.01, K2 0.03."""
    offsets = np.arange(-5, 6)
    g = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window = np.outer(g, g) / np.sum(np.outer(g, g))
    values = []
    for channel in range(3):
        for y in range(5, a.shape[0] - 5):
            for x in range(5, a.shape[1] - 5):
                p, q = a[y - 5 : y + 6, x - 5 : x + 6, channel], b[y - 5 : y + 6, x - 5 : x + 6, channel]
                mp, mq = np.sum(window * p), np.sum(window * q)
                vp, vq = np.sum(window * (p - mp) ** 2), np.sum(window * (q - mq) ** 2)
                cov = np.sum(window * (p - mp) * (q - mq))
                c1, c2 = 0.01**2, 0.03**2
                values.append((2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return np.mean(values)


@pytest.fixture
def images():
    rng = np.random.default_rng(0)
    a = rng.random((16, 14, 3))
    return a, np.clip(a + 0.1 * rng.standard_normal(a.shape), 0, 1)


def test_psnr_of_a_constant_difference():
    a = np.full((4, 5, 3), 100 / 255)
    b = np.full((4, 5, 3), 110 / 255)
    assert psnr(a, b) == pytest.approx(20 * np.log10(255 / 10), rel=1e-12)


def test_psnr_of_equal_images_is_infinite(images):
    assert psnr(images[0], images[0]) == np.inf


def test_images_are_rounded_to_eight_bits_first():
    assert psnr(np.full((4, 5, 3), 100.0 / 255), np.full((4, 5, 3), 100.4 / 255)) == np.inf
    assert mean_squared_error(np.full((4, 5, 3), 100.4 / 255), np.full((4, 5, 3), 100.6 / 255)) == 1 / 255**2


def test_quantize_rounds_and_clips():
    values = np.array([-0.3, 0.0, 0.5 / 255 + 1e-9, 254.4 / 255, 1.0, 7.0]).reshape(1, 2, 3)
    np.testing.assert_array_equal(quantize(values).ravel(), [0, 0, 1, 254, 255, 255])


def test_ssim_matches_its_definition(images):
    a, b = (quantize(image) / 255 for image in images)
    assert ssim(a, b) == pytest.approx(brute_force_ssim(a, b), rel=1e-9)


def test_ssim_of_constant_images():
    a, b, c1 = 51 / 255, 204 / 255, 0.01**2
    value = ssim(np.full((12, 13, 3), a), np.full((12, 13, 3), b))
    assert value == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1), rel=1e-9)


def test_ssim_of_equal_images_is_one(images):
    assert ssim(images[0], images[0]) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_bad_images_are_refused(metric, images):
    a, b = images
    with pytest.raises(ValueError, match="differ in size"):
        metric(a, b[1:])
    b = b.copy()
    b[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        metric(a, b)


def test_ssim_refuses_images_smaller_than_its_window():
    with pytest.raises(ValueError, match="11x11"):
        ssim(np.zeros((10, 20, 3)), np.zeros((10, 20, 3)))


def test_masked_pixels_count_nothing(images):
    """A crop is a mask that everything agrees on: what lies outside may be anything, even the reference itself."""
    a, b = (np.tile(image, (2, 2, 1)) for image in images)
    keep = np.zeros(a.shape[:2], dtype=bool)
    keep[3:20, 5:25] = True
    outside = np.where(keep[..., None], a, b)
    for image in (a, outside):
        assert psnr(image, b, keep) == pytest.approx(psnr(a[3:20, 5:25], b[3:20, 5:25]), rel=1e-12)
        assert ssim(image, b, keep) == pytest.approx(ssim(a[3:20, 5:25], b[3:20, 5:25]), rel=1e-9)
    assert ssim(outside, b) > ssim(outside, b, keep) + 0.01


def test_a_mask_without_a_whole_window_counts_by_centres(images):
    a, b = images
    keep = np.zeros(a.shape[:2], dtype=bool)
    keep[7, 6] = True
    window = slice(2, 13), slice(1, 12)
    assert ssim(a, b, keep) == pytest.approx(ssim(a[window], b[window]), rel=1e-9)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_masks_that_say_nothing_are_refused(metric, images):
    with pytest.raises(ValueError, match="keeps no pixel"):
        metric(*images, np.zeros((16, 14), dtype=bool))
    with pytest.raises(ValueError, match="differ in size"):
        metric(*images, np.ones((14, 16), dtype=bool))
