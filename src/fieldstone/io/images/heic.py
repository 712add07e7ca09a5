"""HEIC photos, as phones write them, where the extra that decodes them is installed."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

HEIC_SUFFIXES = (".heic", ".heif")
HAS_HEIC = find_spec("pi_heif") is not None


@cache
def teach_pillow() -> None:
    """Let Pillow open HEIC, once; it turns photos upright itself, and their EXIF says so."""
    import pi_heif

    pi_heif.register_heif_opener(thumbnails=False)
