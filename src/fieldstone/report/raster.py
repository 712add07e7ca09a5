"""What a figure shows as pixels: photos, clouds of points, maps of numbers."""

from __future__ import annotations

import io

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

JPEG_QUALITY = 80
DRAWN_PX = 1000
"""Longer side in which figures show photos."""
SUBPIXEL_BITS = 4
"""Positions of dots are rounded to 1/16 of a pixel."""


def small(photo: UInt8[np.ndarray, "h w 3"], longest_px: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The photo, shrunk so that no side is longer than `longest_px`; never enlarged."""
    height, width = photo.shape[:2]
    scale = longest_px / max(height, width)
    if scale >= 1.0:
        return photo
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.BOX, reducing_gap=3.0))


def dimmed(photo: UInt8[np.ndarray, "h w 3"], share: float = 0.6) -> UInt8[np.ndarray, "h w 3"]:
    """The photo, darker, so that what is drawn on it stands out."""
    return (np.arange(256) * share).astype(np.uint8)[photo]


def dots_on_ground(
    centers: Float[np.ndarray, "n 2"],
    diameters: Float[np.ndarray, "n"],
    colors: UInt8[np.ndarray, "n 3"],
    size: tuple[int, int],
    ground: tuple[int, int, int],
) -> UInt8[np.ndarray, "h w 3"]:
    """Round dots, later ones over earlier ones, on a plain ground.

    Args:
        centers: Pixels, corner convention; those outside and those that are not finite are left out.
        size: Width and height in pixels.
    """
    pixels = np.empty((size[1], size[0], 3), dtype=np.uint8)
    pixels[:] = ground
    reach = diameters.max(initial=0.0)
    seen = np.all((centers > -reach) & (centers < np.array(size) + reach), axis=1)  # false where not finite
    unit = 1 << SUBPIXEL_BITS
    places = np.round(unit * (centers[seen] - 0.5)).astype(np.int64)  # OpenCV has integers at pixel centres
    smooth_rim = 1.0  # what OpenCV's smoothing adds to a diameter
    radii = np.round(unit * np.maximum(diameters[seen] - smooth_rim, 0.0) / 2).astype(np.int64)
    for place, radius, color in zip(places.tolist(), radii.tolist(), colors[seen].tolist(), strict=True):
        cv2.circle(pixels, place, radius, color, cv2.FILLED, cv2.LINE_AA, SUBPIXEL_BITS)
    return pixels


def color_ramp(values: Float[np.ndarray, "*s"], ramp: int) -> UInt8[np.ndarray, "*s 3"]:
    """Colours of values in [0, 1], clipped to it; `ramp` is one of OpenCV's colour maps."""
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], ramp)[:, 0, ::-1]
    return table[np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.int64)]


def encode_jpeg(pixels: UInt8[np.ndarray, "h w 3"], quality: int = JPEG_QUALITY, *, full_color: bool = False) -> bytes:
    """Pixels as JPEG: the same bytes for the same pixels, no date, no program name.

    Args:
        full_color: Keeps small coloured spots from fading, which photos do not need.
    """
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=quality, subsampling=0 if full_color else 2)
    return buffer.getvalue()


def encode_png(pixels: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Pixels as PNG, exact; for few colours and sharp borders."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
