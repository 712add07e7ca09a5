"""How photos become a verified graph."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from fieldstone.features.pairs import PairOptions
from fieldstone.features.sift import SiftOptions
from fieldstone.solve.robust.two_view import TwoViewOptions


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
    single_camera: bool = False
    """All photos share one camera, whatever their EXIF says."""
    masks: Path | None = None
    """Folder with masks of the photos, see `io.masks`; no features where they are black."""
    threads: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Results are the same for any number."""
