"""What EXIF says about a photo: orientation, focal length in pixels, camera, place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""Of a 35 mm film frame: 43.27 mm."""
MM_PER_RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
SMALLEST_SENSOR_MM = 4.0
"""Longer side; cameras with smaller sensors (phones) give the 35 mm equivalent."""
SMALL_SENSOR_MM, LONGEST_ON_SMALL = 12.0, 4.0
"""A lens that is longer than so many longer sides of a sensor this small stood before a larger one: the photo was made
smaller, and its tags were changed to match."""
COUNTS_DIGITAL_ZOOM = ("apple",)
"""Makers whose 35 mm equivalent is that of the photo, digital zoom included; that of the others is of the lens."""
PLAUSIBLE_FOCAL = (0.1, 20.0)
"""Range of the focal length, as a share of the longer side, outside which EXIF is taken for wrong."""


@dataclass(frozen=True)
class Gps:
    """Place of a photo on WGS 84."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None


@dataclass(frozen=True)
class ExifFacts:
    """What helps to pose a photo; None where EXIF is silent or implausible."""

    focal_px: float | None = None
    """Focal length prior, in pixels of the photo."""
    camera: str | None = None
    """Make and model: photos that share them, their lens, its setting and their size may share intrinsics."""
    lens: tuple[str, float | None, float] | None = None
    """Model of the lens, its focal length in millimetres, and the digital zoom; None if EXIF has none of them."""
    gps: Gps | None = None


def exif_facts(image: Image.Image) -> tuple[int, ExifFacts]:
    """Orientation (1 to 8; 1 if absent or invalid) of the stored pixels, and the other facts."""
    # Pillow's own method for PNG decodes the pixels first, in search of EXIF behind them.
    exif = Image.Image.getexif(image)
    orientation = exif.get(Base.Orientation, 1)
    if not isinstance(orientation, int) or not 1 <= orientation <= 8:
        orientation = 1
    words = [str(exif.get(tag, "")).strip("\0 ") for tag in (Base.Make, Base.Model)]
    camera = " ".join(word for word in words if word) or None
    tags = exif.get_ifd(IFD.Exif)
    focal = _focal_px(tags, *image.size, maker=words[0])
    return orientation, ExifFacts(focal, camera, _lens(tags), _gps(exif.get_ifd(IFD.GPSInfo)))


def _lens(tags: dict[int, Any]) -> tuple[str, float | None, float] | None:
    """What tells settings of lenses apart."""
    lens = str(tags.get(Base.LensModel, "")).strip("\0 "), _number(tags.get(Base.FocalLength)), _digital_zoom(tags)
    return None if lens == ("", None, 1.0) else lens


def _digital_zoom(tags: dict[int, Any]) -> float:
    """By how much the photo was cropped and enlarged; 0 stands for not at all."""
    return max(_number(tags.get(Base.DigitalZoomRatio)) or 1.0, 1.0)


def _focal_px(tags: dict[int, Any], width: int, height: int, *, maker: str) -> float | None:
    """Focal length in pixels: 35 mm equivalent by the diagonal, else millimetres times sensor resolution; times the
    digital zoom.

    The sensor resolution counts pixels of the photo as the camera stored it: a photo that was made smaller since then
    keeps the tag, so the share of the stored width that is left scales it. Where the program that made it smaller wrote
    the new width too, the sensor comes out impossibly small (by itself, or for such a lens), and the tags say nothing.
    """
    diagonal, zoom = math.hypot(width, height), _digital_zoom(tags)
    equivalent = _number(tags.get(Base.FocalLengthIn35mmFilm))
    counted = maker.casefold().startswith(COUNTS_DIGITAL_ZOOM)
    candidates = [] if equivalent is None else [equivalent / FILM_DIAGONAL_MM * diagonal * (1.0 if counted else zoom)]
    focal_mm, resolution = _number(tags.get(Base.FocalLength)), _number(tags.get(Base.FocalPlaneXResolution))
    unit = tags.get(Base.FocalPlaneResolutionUnit, 2)
    if focal_mm is not None and resolution is not None and unit in MM_PER_RESOLUTION_UNIT:
        stored = max(_number(tags.get(tag)) or 0.0 for tag in (Base.ExifImageWidth, Base.ExifImageHeight))
        stored = stored or max(width, height)
        pixels_per_mm = resolution / MM_PER_RESOLUTION_UNIT[unit]
        sensor_mm = stored / pixels_per_mm
        longest = LONGEST_ON_SMALL if sensor_mm < SMALL_SENSOR_MM else math.inf
        if sensor_mm >= SMALLEST_SENSOR_MM and focal_mm <= longest * sensor_mm:
            candidates.append(focal_mm * pixels_per_mm * max(width, height) / stored * zoom)
    low, high = (share * max(width, height) for share in PLAUSIBLE_FOCAL)
    return next((f for f in candidates if low <= f <= high), None)


def _gps(tags: dict[int, Any]) -> Gps | None:
    """Degrees from (degrees, minutes, seconds) and hemisphere letters."""
    latitude = _degrees(tags.get(GPS.GPSLatitude), tags.get(GPS.GPSLatitudeRef), "S", 90.0)
    longitude = _degrees(tags.get(GPS.GPSLongitude), tags.get(GPS.GPSLongitudeRef), "W", 180.0)
    if latitude is None or longitude is None:
        return None
    altitude = _number(tags.get(GPS.GPSAltitude))
    below_sea = tags.get(GPS.GPSAltitudeRef) in (1, b"\x01")
    return Gps(latitude, longitude, None if altitude is None else -altitude if below_sea else altitude)


def _degrees(parts: Any, hemisphere: Any, negative: str, limit: float) -> float | None:
    if not isinstance(parts, tuple) or len(parts) != 3:
        return None
    numbers = [_number(p) for p in parts]
    degrees = sum((n or 0.0) / 60**k for k, n in enumerate(numbers))
    if any(n is None for n in numbers) or degrees > limit:
        return None
    return -degrees if str(hemisphere).upper().startswith(negative) else degrees


def _number(value: Any) -> float | None:
    """A finite number that is not negative; rationals with denominator zero are none."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number >= 0 else None
