"""What a mapper tells of its stages: reprojections before and after each, and everything it dropped and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.records.mapping import CameraCertainty, CameraTrial, ErrorRow
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Reconstruction


@dataclass(frozen=True, eq=False)
class StageRecord:
    """Observed and reprojected pixels of one photo at one stage; a reprojection is nan behind the camera."""

    stage: str
    view: int
    name: str
    pixels: Float[np.ndarray, "n 2"]
    reprojected: Float[np.ndarray, "n 2"]

    def errors(self) -> Float[np.ndarray, "m"]:
        """Reprojection errors in pixels, of the points in front of the camera."""
        distance = np.linalg.norm(self.reprojected - self.pixels, axis=1)
        return distance[np.isfinite(distance)]

    def row(self) -> ErrorRow:
        """One row of the error table."""
        errors = self.errors()
        some = len(errors) > 0
        return ErrorRow(
            stage=self.stage,
            photo=self.name,
            points=len(errors),
            behind=len(self.pixels) - len(errors),
            mean_px=float(errors.mean()) if some else None,
            median_px=float(np.median(errors)) if some else None,
            rms_px=float(np.sqrt(np.mean(errors**2))) if some else None,
        )


@dataclass(frozen=True)
class Drop:
    """Observations taken out of the model at one stage, and why."""

    stage: str
    reason: str
    observations: int


@dataclass(frozen=True, eq=False)
class InitialPair:
    """The pair that the model started from: its four candidate poses and how many points each puts in front."""

    pair: ImagePair
    candidates: tuple[Rigid3, ...]
    in_front: Int[np.ndarray, "c"]
    chosen: int
    points: tuple[Float[np.ndarray, "_ 3"], ...]
    """Triangulated points of every candidate, in the first camera's frame."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well poses and points are determined, in the model's frame and unit; nan for photos without a pose."""

    of_views: Float[np.ndarray, "v 6 6"]
    """Covariances of the right tangent (omega, v) of `cam_from_world`, see `Rigid3.retract`."""
    of_points: Float[np.ndarray, "p 3 3"]
    """Covariances, in the order of the reconstruction's points."""
    sigma_px: float
    """Standard deviation of an observation per axis, estimated from the errors that are left; pixels of the photos."""
    rotation_deg: Float[np.ndarray, "v"]
    """Standard deviations: the root of the summed variances."""
    center: Float[np.ndarray, "v"]


@dataclass(frozen=True, eq=False)
class MappingRun:
    """A reconstruction and the story of how it came about."""

    reconstruction: Reconstruction
    graph: MatchGraph
    initial_pair: InitialPair | None
    records: tuple[StageRecord, ...]
    drops: tuple[Drop, ...]
    before_bundle: Reconstruction | None
    """The model before the last round of bundle adjustment."""
    verdicts: dict[str, str]
    """For every photo: registered, or why not."""
    others: tuple[Reconstruction, ...] = ()
    """Further components, ranked; they share no photo with the reconstruction."""
    alternative: tuple[Reconstruction, ...] = ()
    """Other models of the same photos, where these do not tell which are true; a note says what speaks for each."""
    notes: tuple[str, ...] = ()
    """Decisions of the mapper that a user should know of, such as the calibration it found."""
    uncertainty: Uncertainty | None = None
    """Of the reconstruction, if it was asked for."""
    calibration: tuple[CameraTrial, ...] = ()
    """Camera models that were tried on the reconstruction, in order."""
    certainties: tuple[CameraCertainty, ...] = ()
    """Of the reconstruction's cameras, where the mapper tells it."""
