"""What the order of the photos tells, where they were taken while walking around something."""

from __future__ import annotations

import numpy as np

from fieldstone.geometry.rotation import exp, log
from fieldstone.mapping.disambiguation.options import DisambiguationOptions
from fieldstone.mapping.disambiguation.rotation_forest import Pairs, RotationForest, rotation_angles


def pairs_in_order(pairs: Pairs, num_photos: int, options: DisambiguationOptions) -> tuple[int, ...]:
    """The pairs of photos that follow each other, with steps over one photo where those are missing.

    Returns:
        Rows of `pairs`; empty where too few photos follow each other.
    """
    gap = pairs.second - pairs.first
    forest = RotationForest.bare(num_photos)
    for k in np.lexsort((-pairs.inliers, gap)).tolist():
        joins = forest.component[pairs.first[k]] != forest.component[pairs.second[k]]
        if gap[k] <= 2 and pairs.inliers[k] >= options.min_strong_inliers and joins:
            forest = forest.joined(pairs, k)
    return forest.edges if len(forest.edges) >= options.order.min_same_turn * (num_photos - 1) else ()


def forest_in_order(pairs: Pairs, num_photos: int, options: DisambiguationOptions) -> RotationForest | None:
    """The forest of pairs that are near in the order of the photos, if the steps from photo to photo turn the same way.

    Steps over a corner may be wrong or missing: pairs that skip a photo or two bridge them, if they turn as far.
    """
    order = options.order
    gap = pairs.second - pairs.first
    steps = np.flatnonzero(gap == 1)
    if len(steps) < max(order.min_steps, order.min_same_turn * (num_photos - 1)):
        return None
    one = np.median(log(pairs.cam2_R_cam1[steps]), axis=0)
    off = rotation_angles(pairs.cam2_R_cam1 @ np.swapaxes(exp(gap[:, None] * one), 1, 2))
    limits = options.forest.agreement, np.deg2rad(order.max_unevenness_deg)
    as_expected = off < np.clip(0.5 * gap * np.linalg.norm(one), *limits)
    too_few = as_expected[steps].sum() < order.min_same_turn * (num_photos - 1)
    if too_few or np.linalg.norm(one) < np.deg2rad(order.min_turn_deg):
        return None
    forest = RotationForest.bare(num_photos)
    for k in np.lexsort((-pairs.inliers, gap)).tolist():
        if (
            gap[k] <= order.max_gap
            and as_expected[k]
            and forest.component[pairs.first[k]] != forest.component[pairs.second[k]]
        ):
            forest = forest.joined(pairs, k)
    return forest
