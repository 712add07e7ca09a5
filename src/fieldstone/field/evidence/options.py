"""How far photos and triangulated points are believed."""

from __future__ import annotations

from dataclasses import dataclass, field, fields


def _check_positive(options: FreeSpaceOptions | FloaterOptions | PoseOptions) -> None:
    for setting in fields(options):
        if not getattr(options, setting.name) > 0:
            raise ValueError(f"{setting.name} must be greater than 0, got {getattr(options, setting.name)}")


@dataclass(frozen=True)
class FreeSpaceOptions:
    """What photos look through, see `free_space`."""

    free_fraction: float = 0.7
    """Space is empty up to this fraction of the distance of triangulated points: what has none may stand before
    them."""
    free_loss_fraction: float = 0.92
    """And probably up to this fraction of the least distance of the points around."""
    neighbours: int = 8
    """Points in a photo that speak for the pixels near them."""
    blocks: int = 48
    """They are found for so many blocks along the longer side of the photo."""
    min_points: int = 20
    """Fewer points of a photo say nothing of its space."""
    near_percent: float = 90.0
    """Percentile of the distances of its points up to which a place is near to a photo."""
    around_percent: float = 5.0
    """Up to `free_fraction` of this percentile of the distances of its points, a place is around a photo."""
    min_views: int = 3
    """What is near to a photo is seen by so many photos, if there are `many_photos`; else by 2."""
    many_photos: int = 8

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class FloaterOptions:
    """What hangs in the air, see `floaters`."""

    max_fraction: float = 0.3
    """If more of what is solid were to go than this, the points do not speak for the scene, and all stays."""

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class PoseOptions:
    """How poses are refined, see `pose_refinement`."""

    size_px: int = 112
    """Longer side of the pictures that are compared."""
    sigma_px: float = 0.5
    """Standard deviation of a triangulated point in a photo, in pixels of the photo."""
    min_points: int = 20
    """Photos that see fewer are held as if they saw the corners of a cube in the middle of the scene, with
    `unknown_sigma_px`."""
    unknown_sigma_px: float = 3.0
    correlated_pixels: float = 30.0
    """Neighbouring pixels are wrong together: so many count as one."""
    min_opacity: float = 0.5
    """What is less opaque is no surface."""
    max_depth_ratio: float = 1.1
    """Neighbouring pixels whose depths differ more do not lie on one surface."""
    min_sigma: float = 0.004
    """Of colours: 8 bits do not know them better than to one level."""

    def __post_init__(self) -> None:
        _check_positive(self)


@dataclass(frozen=True)
class EvidenceOptions:
    """All of them."""

    free_space: FreeSpaceOptions = field(default_factory=FreeSpaceOptions)
    floaters: FloaterOptions = field(default_factory=FloaterOptions)
    poses: PoseOptions = field(default_factory=PoseOptions)


DEFAULT_EVIDENCE = EvidenceOptions()
