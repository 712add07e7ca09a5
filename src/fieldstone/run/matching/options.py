"""How photos become a verified graph."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from fieldstone.features.pairs import PairOptions
from fieldstone.features.sift import SiftOptions
from fieldstone.solve.robust.two_view import TwoViewOptions

Sharing = Literal["auto", "one", "per-folder", "per-photo"]
"""Which photos share a camera: those of one EXIF body, lens and zoom, as far as the pairs of photos agree; all of one
size; all of one size in a folder; none."""


@dataclass(frozen=True)
class MatchingOptions:
    """From photos to a verified graph."""

    sift: SiftOptions = field(default_factory=SiftOptions)
    max_ratio: float = 0.8
    """Ratio test of the matcher."""
    pairs: PairOptions = field(default_factory=PairOptions)
    """Which pairs of photos are matched."""
    two_view: TwoViewOptions = field(default_factory=TwoViewOptions)
    camera_model: str | None = None
    """Model of given intrinsics; None: PINHOLE for four numbers, SIMPLE_PINHOLE for three."""
    intrinsics: tuple[float, ...] | None = None
    """Parameters of the model, in pixels of the stored photo; None: from EXIF, or from the photos themselves."""
    fix_intrinsics: bool = False
    """Given intrinsics are exact."""
    cameras: Sharing = "auto"
    """Which photos share a camera."""
    masks: Path | None = None
    """Folder with masks of the photos, see `io.masks`; no features where they are black."""
    threads: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Results are the same for any number."""
