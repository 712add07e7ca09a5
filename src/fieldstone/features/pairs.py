"""Which pairs of photos are worth matching."""

from __future__ import annotations

from collections.abc import Sequence

from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import ImagePair


def exhaustive(features: Sequence[Features]) -> list[ImagePair]:
    """All pairs (i, j), i < j, of photos that have features."""
    filled = [i for i, f in enumerate(features) if len(f)]
    return [(i, j) for k, i in enumerate(filled) for j in filled[k + 1 :]]
