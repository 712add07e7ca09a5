"""When a model is weak, and when it is doubtful."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldstone.solve.robust.two_view import TwoViewOptions


@dataclass(frozen=True)
class Limits:
    """Beyond the first number a result is weak, beyond the second it is doubtful."""

    weak: float
    doubtful: float

    def __post_init__(self) -> None:
        if not 0 <= self.weak <= self.doubtful:
            raise ValueError(f"weak comes before doubtful, got {self.weak} and {self.doubtful}")


@dataclass(frozen=True)
class GradingOptions:
    """What is asked of a model. Shares are of matches, so that pairs count by what they know."""

    max_pairs: int = 150
    """Of more, a sample is asked."""
    two_view: TwoViewOptions = field(default_factory=TwoViewOptions)
    """How the geometry of a pair is found again."""
    error_added: Limits = field(default_factory=lambda: Limits(1 / 3, 4 / 5))
    """Share of the errors' variance that is the model's doing, at the median match."""
    lost: Limits = field(default_factory=lambda: Limits(0.1, 0.15))
    """Share of matches that the model does not explain."""
    denied: Limits = field(default_factory=lambda: Limits(0.03, 0.1))
    """Share of matches in pairs of which the model explains less than half: it shows such pairs at different places. A
    building that is folded upon itself denies no more than the pairs along the folds."""
    turned: Limits = field(default_factory=lambda: Limits(0.05, 0.5))
    """Share of matches in pairs that want another relative rotation."""
    contradicted: Limits = field(default_factory=lambda: Limits(0.0, 0.5))
    """Share of photos whose pairs contradict their place."""
    other_focal: Limits = field(default_factory=lambda: Limits(0.0, 0.5))
    """Share of photos whose pairs want another focal length."""
    uncertain_cameras: Limits = field(default_factory=lambda: Limits(1 / 3, 1.0))
    """Share of photos whose camera the photos do not determine well."""
    max_focal_sd: float = 0.005
    """Of a camera that is determined: standard deviation of its focal length, as a share of it."""
    left_out: Limits = field(default_factory=lambda: Limits(0.1, 1.0))
    """Share of pairs that mapping took to be false."""
    min_turn_deg: float = 3.0
    """Other rotations than those of the model count from here on, where they are significant."""
    min_focal_change: float = 0.05
    """Other focal lengths count from this share on, where they are significant."""
    standard_errors: float = 4.0
    """What is significant. Errors are not normal, and there are many photos."""
    min_points: int = 30
    """Photos with fewer points are weakly held."""
    min_common_points: int = 15
    """Two photos with fewer points in common do not hold each other."""
    max_pixel_ratio: Limits = field(default_factory=lambda: Limits(0.02, 0.05))
    """How far fx / fy may be from 1: pixels are square."""
