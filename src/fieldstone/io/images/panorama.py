"""Whether a picture is a panorama, by what its XMP says."""

from __future__ import annotations

import re

from PIL import Image

XMP_KEYS = ("xmp", "XML:com.adobe.xmp")
"""Where Pillow puts the XMP of JPEG and WebP, and of PNG."""
XMP_TAG = 700
"""Of TIFF."""
STATED = re.compile(
    rb"""GPano:(ProjectionType\s*(=\s*["']|>)\s*(equirectangular|cylindrical)|UsePanoramaViewer\s*(=\s*["']|>)\s*true)""",
    re.IGNORECASE,
)
"""A property of the schema GPano, written as an attribute or as an element."""


def is_panorama(image: Image.Image) -> bool:
    """Whether XMP states that a picture is the picture of a sphere or a cylinder, not of a plane."""
    found = [image.info.get(key) for key in XMP_KEYS]
    found.append(getattr(image, "tag_v2", {}).get(XMP_TAG))
    return any(STATED.search(xmp if isinstance(xmp, bytes) else str(xmp).encode()) for xmp in found if xmp)
