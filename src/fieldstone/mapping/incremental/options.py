"""Thresholds of incremental registration, and the stages in which they are relaxed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from fieldstone.mapping.model.refinement import RefinementOptions
from fieldstone.solve.robust.ransac import RansacOptions


@dataclass(frozen=True)
class RetryStage:
    """Thresholds of one stage of registration; the first is strict, the later ones relax."""

    min_initial_angle_deg: float
    """Median angle at which the rays of an initial pair meet."""
    min_initial_points: int
    """Points of an initial pair."""
    min_inliers: int
    """Observations that agree with the pose of a photo."""
    min_angle_deg: float
    """Points whose rays meet at a smaller angle are no points."""


RETRY_STAGES = (
    RetryStage(min_initial_angle_deg=8.0, min_initial_points=100, min_inliers=30, min_angle_deg=1.5),
    RetryStage(min_initial_angle_deg=4.0, min_initial_points=50, min_inliers=20, min_angle_deg=1.0),
    RetryStage(min_initial_angle_deg=1.5, min_initial_points=25, min_inliers=12, min_angle_deg=0.5),
)


@dataclass(frozen=True)
class IncrementalOptions:
    """How photos are registered one after the other."""

    max_error_px: float = 4.0
    """Observations with a larger reprojection error are no inliers of their point. Like every number of pixels here, it
    is multiplied by the pixel scale of the photo."""
    pnp: RansacOptions = field(default_factory=lambda: RansacOptions(max_error_px=8.0))
    """Registration of a photo."""
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    """Bundle adjustment between registrations and at the end."""
    min_model_size: int = 2
    """Smallest sub-model that is kept."""
    max_initial_pairs: int = 8
    """Pairs tried as the start of one sub-model, at each retry stage."""
    min_kept_points: float = 0.5
    """A step after which a smaller share of the points is left is undone."""

    def with_threads(self, threads: int) -> IncrementalOptions:
        """The same with so many threads, which changes nothing but the time."""
        return replace(self, refinement=replace(self.refinement, threads=threads))
