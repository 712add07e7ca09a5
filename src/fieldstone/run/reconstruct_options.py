"""What a user may choose of a reconstruction; apart from the other options, since its stages take time to load."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from fieldstone.errors import InputError
from fieldstone.features.pairs import PairOptions
from fieldstone.features.sift import SiftOptions
from fieldstone.mapping.automatic import AutomaticOptions
from fieldstone.mapping.grading.options import GradingOptions
from fieldstone.mapping.textbook import TextbookOptions
from fieldstone.run.matching.options import MatchingOptions, Sharing
from fieldstone.run.options import NumbersOption, at_least, workers
from fieldstone.solve.robust.two_view import TwoViewOptions

Mapper = Literal["auto", "textbook", "incremental", "global"]


@dataclass(frozen=True)
class Tuning:
    """What the stages of a reconstruction can be told beyond what users need."""

    sift: SiftOptions = field(default_factory=SiftOptions)
    """`max_image_size` of `ReconstructOptions` stands above the one in here."""
    pairs: PairOptions = field(default_factory=PairOptions)
    max_ratio: float = 0.8
    """Ratio test of the matcher."""
    two_view: TwoViewOptions = field(default_factory=TwoViewOptions)
    textbook: TextbookOptions = field(default_factory=TextbookOptions)
    mapping: AutomaticOptions = field(default_factory=AutomaticOptions)
    grading: GradingOptions = field(default_factory=GradingOptions)


@dataclass(frozen=True)
class ReconstructOptions:
    """How photos become a scene.

    Raises:
        InputError: A value that no photos could be reconstructed with.
    """

    mapper: Mapper = "auto"
    """auto takes the textbook's stages for given matches, the incremental mapper for photos; global places all photos
    at once, which is faster for large sets."""
    camera_model: str | None = None
    """Model of the given intrinsics, such as SIMPLE_RADIAL or OPENCV."""
    intrinsics: NumbersOption = None
    """Its parameters in pixels of the stored photo, as fx,fy,cx,cy."""
    fix_intrinsics: bool = False
    """They are exact: do not refine them."""
    fix_principal_point: bool = False
    """Hold the principal point."""
    covariance: bool = False
    """Also compute how well poses and points are determined: covariance.safetensors, and the standard deviations of
    every pose in run.json."""
    cameras: Sharing = "auto"
    """Which photos share a camera. auto: those of one EXIF body, lens and zoom and, without EXIF, of one size, unless
    the photos tell several cameras apart; one: all; per-folder: those in one folder; per-photo: none."""
    masks: Path | None = None
    """Folder with a mask for each photo, named a.jpg.png, a.jpg or a.png for a.jpg. White is kept."""
    max_image_size: int = 1600
    """Longer side of the photos for finding features, in pixels."""
    threads: int = 0
    """0 takes all cores. The result is the same for any number."""
    seed: int = 0
    """Every random number of the run follows from it."""
    fresh: bool = False
    """Start from nothing, whatever an earlier run has kept in the output folder."""
    tuning: tyro.conf.Suppress[Tuning] = field(default_factory=Tuning)
    """For those who know the stages."""

    def __post_init__(self) -> None:
        at_least(1, max_image_size=self.max_image_size)
        at_least(0, threads=self.threads, seed=self.seed)
        if self.fix_intrinsics and self.intrinsics is None:
            raise InputError("`fix_intrinsics` needs `intrinsics`: there is nothing to hold")
        if self.camera_model is not None and self.intrinsics is None:
            raise InputError(
                f"`camera_model` {self.camera_model} needs `intrinsics`: it says what they mean; "
                "without them, the photos choose the model"
            )

    def matching(self) -> MatchingOptions:
        """From photos to a verified graph."""
        return MatchingOptions(
            sift=replace(self.tuning.sift, max_image_size=self.max_image_size),
            max_ratio=self.tuning.max_ratio,
            pairs=self.tuning.pairs,
            two_view=self.tuning.two_view,
            camera_model=self.camera_model,
            intrinsics=self.intrinsics,
            fix_intrinsics=self.fix_intrinsics,
            cameras=self.cameras,
            masks=self.masks,
            threads=workers(self.threads),
        )

    def mapping(self, mapper: Literal["incremental", "global"]) -> AutomaticOptions:
        """From the graph to models."""
        tuned = self.tuning.mapping
        calibration = replace(
            tuned.self_calibration,
            principal_point=tuned.self_calibration.principal_point and not self.fix_principal_point,
        )
        tuned = replace(
            tuned, mapper=mapper, self_calibration=calibration, covariance=self.covariance or tuned.covariance
        )
        return tuned.with_threads(workers(self.threads))
