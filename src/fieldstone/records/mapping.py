"""`run.json`: how photos became a model, told by numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.camera_models import CAMERA_MODELS

Certainty = Literal["well determined", "weak", "assumed"]
"""Of a camera's intrinsics."""


@dataclass(frozen=True)
class CameraCertainty:
    """How well the photos determine a camera."""

    sds: tuple[float | None, ...]
    """Standard deviation of every parameter, in the order of the model; None where it was held."""
    word: Certainty
    reason: str


@dataclass(frozen=True)
class CameraRecord:
    """A camera: its model, its size in pixels and its parameters, in the order of the model."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    sds: tuple[float | None, ...] = ()
    """Standard deviation of every parameter; None where it was held, empty where nothing is known of it."""
    certainty: Certainty | None = None
    """How well the photos determine the camera."""
    reason: str = ""
    """Why that is said."""

    @staticmethod
    def of(camera: Camera, certainty: CameraCertainty | None = None) -> CameraRecord:
        """What is written of a camera."""
        record = CameraRecord(camera.model, camera.width, camera.height, tuple(camera.params.tolist()))
        if certainty is None:
            return record
        return replace(record, sds=certainty.sds, certainty=certainty.word, reason=certainty.reason)

    def params_with_sds(self) -> str:
        """Parameters by name, with their standard deviations where these are known."""
        sds = self.sds or (None,) * len(self.params)
        names = CAMERA_MODELS[self.model].param_names
        return ", ".join(
            f"{name} {value:.6g}" + ("" if sd is None else f" ± {sd:.2g}")
            for name, value, sd in zip(names, self.params, sds, strict=True)
        )

    def camera(self) -> Camera:
        """The camera."""
        return Camera(self.model, self.width, self.height, np.array(self.params))


@dataclass(frozen=True)
class PhotoVerdict:
    """One photo: whether it found its place, and the number that decided it."""

    name: str
    registered: bool
    verdict: str
    points: int
    sd_rotation_deg: float | None = None
    """Standard deviation of its rotation, where covariances were asked for."""
    sd_center: float | None = None
    """And of its position, in units of the model."""


@dataclass(frozen=True)
class ErrorRow:
    """Reprojection errors of one photo at one stage; None where no point has one."""

    stage: str
    photo: str
    points: int
    behind: int
    """Points behind the camera, which have no error."""
    mean_px: float | None
    median_px: float | None
    rms_px: float | None


@dataclass(frozen=True)
class CameraTrial:
    """A camera model that was tried: what held-out observations say of it, and whether it was taken."""

    model: str
    free: tuple[str, ...]
    """Names of the parameters that were refined."""
    rms_before_px: float
    """Robust root mean square of prediction by the simplest model."""
    rms_after_px: float
    significance: float
    """Of the gain, in standard errors."""
    accepted: bool
    verdict: str = ""
    """Why, or why not."""


@dataclass(frozen=True)
class DropRecord:
    """Observations taken out of the model at one stage, and why."""

    stage: str
    reason: str
    observations: int


GradeWord = Literal["good", "weak", "doubtful"]


@dataclass(frozen=True)
class GradeReason:
    """One thing that speaks against a result."""

    word: Literal["weak", "doubtful"]
    """What it makes of the grade."""
    reason: str
    """With the numbers that decided."""
    advice: str
    """What to do about it."""


@dataclass(frozen=True)
class Grade:
    """How far the first model can be believed, by an independent check after mapping; None where it had nothing to say.

    The check asks the matches of pairs of photos again, without poses and focal lengths, and holds the model against
    what they say.
    """

    word: GradeWord
    """The worst of the reasons; good without any."""
    reasons: tuple[GradeReason, ...]
    """The gravest first."""
    pairs: int = 0
    """That were asked."""
    matches_kept: float | None = None
    """Share of their matches that the model explains."""
    error_added: float | None = None
    """Share of the variance of the matches' epipolar errors that their own geometry does not have; of the median."""
    matches_denied: float | None = None
    """Share of matches in pairs of which the model explains less than half."""
    matches_turned: float | None = None
    """Share of matches in pairs that would turn their cameras against each other, significantly."""
    other_focal: tuple[str, ...] = ()
    """Photos whose pairs want another focal length, significantly."""
    contradicted: tuple[str, ...] = ()
    """Photos whose pairs contradict their place."""
    weakly_held: tuple[str, ...] = ()
    """Photos that few points hold, or that alone hold parts of the model together."""


@dataclass(frozen=True)
class ModelSummary:
    """The numbers of a model that one looks at first; None where nothing is observed."""

    registered: int
    photos: int
    points: int
    observations: int
    mean_px: float | None
    median_px: float | None
    rms_px: float | None
    mean_track_length: float | None


@dataclass(frozen=True)
class TruthErrors:
    """Errors against a known truth, after the similarity that brings the model into its frame (metres)."""

    photos: int
    rotation_error_mean_deg: float
    rotation_error_max_deg: float
    position_error_mean_m: float
    position_error_max_m: float
    focal_error_percent: float


@dataclass(frozen=True)
class RunRecord:
    """All that `run.json` tells of a reconstruction."""

    version: str
    input: str
    """Name of the folder that it was made from."""
    mapper: str
    seed: int
    seconds: Mapping[str, float]
    """Of every stage, in order."""
    summary: ModelSummary
    components: tuple[int, ...]
    """Registered photos of every model, the largest first."""
    cameras: tuple[CameraRecord, ...]
    notes: tuple[str, ...]
    """Decisions that a user should know of."""
    photos: tuple[PhotoVerdict, ...]
    table: tuple[ErrorRow, ...]
    drops: tuple[DropRecord, ...]
    how_errors_are_counted: str
    calibration: tuple[CameraTrial, ...] = ()
    """Camera models that were tried on the first model, in order."""
    photos_folder: str | None = None
    """Where the photos lie, relative to the folder of the run, so that the two may move together."""
    masks_folder: str | None = None
    alternative: tuple[int, ...] = ()
    """Registered photos of the models of an alternative, which follow the others: where places look alike and the
    photos do not tell which is true."""
    grade: Grade | None = None
    """How far the first model can be believed."""
    truth: TruthErrors | None = field(default=None)
    """Where the photos are made, and the truth is known."""
