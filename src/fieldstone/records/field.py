"""What is written of a trained field: the header of its checkpoint, its curve, and the metrics of held-out views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fieldstone.records.mapping import CameraRecord


@dataclass(frozen=True)
class CurvePoint:
    """One step of a training curve; psnr is that of the step's own batch of training rays, in dB."""

    step: int
    seconds: float
    loss: float
    psnr: float


@dataclass(frozen=True)
class FrameRecord:
    """Where a field lives, see `FieldFrame`: normalised from world as scale, R, t; range of rays; background."""

    scale: float
    R: tuple[tuple[float, ...], ...]
    t: tuple[float, ...]
    near: float
    far: float
    background: tuple[float, ...]


@dataclass(frozen=True)
class FieldHeader:
    """What a checkpoint says of its run; equal headers mean that training can go on."""

    field: str
    """fast, tiny or nerf."""
    options: Mapping[str, Any]
    """Of the network, or of the grids."""
    seed: int
    photos: str
    """SHA-256 of the training photos as they are used, with names and poses."""
    frame: FrameRecord
    names: tuple[str, ...]
    """Of the training photos."""
    cameras: tuple[CameraRecord, ...]
    camera_of_view: tuple[int, ...]

    def differences(self, other: FieldHeader) -> list[str]:
        """Names of what differs."""
        return [name for name in self.__dataclass_fields__ if getattr(self, name) != getattr(other, name)]


@dataclass(frozen=True)
class ViewScores:
    """How alike a rendered view and its photo are: PSNR in dB, SSIM."""

    psnr: float
    ssim: float


@dataclass(frozen=True)
class FieldMetrics:
    """All that `metrics.json` tells of a training."""

    psnr: float | None
    """Mean over the held-out views; None if no photo was held out."""
    ssim: float | None
    views: Mapping[str, ViewScores]
    """Held-out views by label."""
    protocol: str
    """How views and photos were compared."""
    seconds: float
    """Of reading and training, those before a stop included."""
    steps: int
    field: str
    device: str
    threads: int
    seed: int
    version: str
    alpha: bool | None = None
    """Whether the transparency of photos was used; None for the classical networks."""
    plan: Mapping[str, Any] | None = None
    """The plan that the grid field followed."""
