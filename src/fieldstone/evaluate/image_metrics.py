"""How near a rendered image comes to the photo: PSNR and SSIM, one protocol for every field.

Both images are rounded to 8 bits per channel first, because that is what is stored and what others publish; PSNR
comes from the mean squared error of each image, and a set of images is summarised by the mean of its values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_erosion
from skimage.metrics import structural_similarity

PROTOCOL = (
    "both images rounded to 8-bit sRGB; PSNR per image from its mean squared error, then the mean over images; "
    "SSIM with an 11x11 Gaussian window of sigma 1.5, K1 0.01, K2 0.03, borders left out, mean over channels"
)

SSIM_WINDOW = 11


def quantize(image: Float[np.ndarray, "*b h w 3"]) -> UInt8[np.ndarray, "*b h w 3"]:
    """Colours in [0, 1] as 8-bit values: clipped, then rounded to the nearest.

    Raises:
        ValueError: A value is not finite.
    """
    if not np.all(np.isfinite(image)):
        raise ValueError(f"an image must be finite, got {np.count_nonzero(~np.isfinite(image))} values that are not")
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def mean_squared_error(
    image: Float[np.ndarray, "h w 3"],
    reference: Float[np.ndarray, "h2 w2 3"],
    keep: Bool[np.ndarray, "h3 w3"] | None = None,
) -> float:
    """Mean over pixels and channels of the squared difference, after rounding both to 8 bits; colours in [0, 1].

    Args:
        keep: Pixels that count; None: all.

    Raises:
        ValueError: The images or the mask differ in size, none of the pixels counts, or values are not finite.
    """
    _check_same_size(image, reference, keep)
    difference = quantize(image).astype(np.int64) - quantize(reference).astype(np.int64)
    return float(np.mean(difference[... if keep is None else keep] ** 2)) / 255.0**2


def psnr(
    image: Float[np.ndarray, "h w 3"],
    reference: Float[np.ndarray, "h2 w2 3"],
    keep: Bool[np.ndarray, "h3 w3"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10(MSE); inf for images that are equal at 8 bits.

    Args:
        keep: Pixels that count; None: all.

    Raises:
        ValueError: As `mean_squared_error`.
    """
    mse = mean_squared_error(image, reference, keep)
    return float("inf") if mse == 0.0 else float(-10.0 * np.log10(mse))


def ssim(
    image: Float[np.ndarray, "h w 3"],
    reference: Float[np.ndarray, "h2 w2 3"],
    keep: Bool[np.ndarray, "h3 w3"] | None = None,
) -> float:
    """Structural similarity in [-1, 1]; 1 for equal images.

    With a mask, only windows that lie wholly in it count: no window mixes what is measured with what is not. Where the
    mask holds no whole window, those count whose centre is in it.

    Args:
        keep: Pixels that count; None: all.

    Raises:
        ValueError: The images or the mask differ in size, are smaller than the 11x11 window, or are not finite; or none
            of the pixels counts.

    Source:
        `wang2004`, eq. 13, with the population covariance; pixels whose window leaves the image are left out.
    """
    _check_same_size(image, reference, keep)
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, got {image.shape[:2]}")
    found: Any = structural_similarity(
        quantize(image) / 255.0,
        quantize(reference) / 255.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    mean, of_pixels = found
    if keep is None:
        return float(mean)
    whole = np.asarray(binary_erosion(keep, np.ones((SSIM_WINDOW, SSIM_WINDOW), dtype=bool)))
    return float(np.mean(of_pixels[whole if whole.any() else keep]))


def _check_same_size(image: np.ndarray, reference: np.ndarray, keep: np.ndarray | None) -> None:
    if image.shape != reference.shape:
        raise ValueError(f"images differ in size: {image.shape} and {reference.shape}")
    if keep is not None and keep.shape != image.shape[:2]:
        raise ValueError(f"image and mask differ in size: {image.shape[:2]} and {keep.shape}")
    if keep is not None and not keep.any():
        raise ValueError("the mask keeps no pixel: there is nothing to compare")
