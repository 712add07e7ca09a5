"""When pairs of a scene that repeats itself are taken for false."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class AgreementOptions:
    """When a pair agrees with a model, and when it contradicts it."""

    max_error_px: float = 8.0
    """A match agrees where the point of its one keypoint appears this near to the other, times the pixel scale."""
    min_tested: int = 8
    """With fewer matches that have a point, nothing is said of a pair."""
    agreeing: float = 0.5
    """Pairs of which this share of the matches agrees are those of the model."""
    contradicting: float = 0.3
    """Pairs of which less agrees contradict it."""


@dataclass(frozen=True)
class MissingOptions:
    """How missing correspondences are counted."""

    grids: tuple[tuple[int, int, float], ...] = ((6, 4, 0.0), (6, 4, 0.5))
    """Columns, rows and shift in cells of the regions of a photo; two grids, so that no region lies on borders only."""
    min_parallax_deg: float = 1.0
    """Rays that meet at a smaller angle tell no depth."""
    min_common_depths: int = 5
    """Depths that two pairs of a photo share, for the one to give the other its scale."""
    max_angle_deg: float = 20.0
    """In a model: two photos see a point from the same side if their rays meet at a smaller angle ..."""
    max_scale: float = 1.6
    """... and their distances from it differ by a smaller factor."""
    margin: float = 0.02
    """Nothing is expected this near to the edge of a photo, as a share of its longer side."""
    neighbors: int = 24
    """Photos around each that are asked for its points."""
    points_per_photo: int = 1000
    """Photos with more points on average are thinned out to about as many."""


@dataclass(frozen=True)
class ForestOptions:
    """Which pairs span the rotation forest, and which agree with it."""

    agreement_deg: float = 15.0
    """Pairs whose rotation differs by less from that of their tree agree with it: the drift along its edges."""
    narrow_deg: float = 10.0
    """Only pairs whose rays meet at an angle up to this much above the smallest tell how much is missing."""
    features_per_region: int = 4
    """Features that are missing together count as one observation."""
    significance: float = 0.01
    """How sure it is that one group of pairs misses less than another ..."""
    clear_ratio: float = 2.0
    """... and how much less."""
    inversion_ratio: float = 3.0
    """How much more than wider pairs next to them pairs have to miss for not being believed."""
    min_density: float = 0.5
    """Ratio of the density of pairs between two trees to that inside either, at least."""

    @property
    def agreement(self) -> float:
        """`agreement_deg` in radians."""
        return float(np.deg2rad(self.agreement_deg))


@dataclass(frozen=True)
class PhotoOrderOptions:
    """When the order of the photos is that of a walk around something."""

    min_same_turn: float = 0.75
    """Ratio of the steps from photo to photo, in their order, that go on turning the same way: taken while walking."""
    min_steps: int = 8
    min_turn_deg: float = 2.0
    """How far the steps turn at least."""
    max_unevenness_deg: float = 35.0
    """How far a step is from their mean at most; false pairs turn by a side more or less."""
    max_gap: int = 3
    """Photos that lie so near in their order are joined by pairs that turn as the steps do."""


@dataclass(frozen=True)
class DisambiguationOptions:
    """When a scene counts as one that repeats itself."""

    suspicion: float = 0.005
    """Share of the inliers that has to contradict the model of all pairs before any other is tried: chance matches
    make less."""
    contradiction: float = 0.05
    """A model that so large a share contradicts is not believed, even if nothing tells what is true."""
    min_explained: float = 0.9
    """Other models have to hold as many of the photos."""
    better: float = 1.5
    """Factor by which less has to be missing in another model."""
    min_strong_inliers: int = 30
    """Fewer agreeing matches can come about by chance."""
    min_group: int = 2
    """A single pair may be wrong for many reasons; places that look alike give several that say the same."""
    min_denied: float = 30.0
    """Features that deny a bridge between parts of a model, at least; and more than hold it."""
    agreement: AgreementOptions = field(default_factory=AgreementOptions)
    missing: MissingOptions = field(default_factory=MissingOptions)
    forest: ForestOptions = field(default_factory=ForestOptions)
    order: PhotoOrderOptions = field(default_factory=PhotoOrderOptions)
