"""Which photos would have another focal length, if their pairs alone were asked.

A score test: at the model's focal lengths, every pair has a gradient of its squared epipolar errors and an information
about the logarithms of two focal lengths, with the relative pose of the pair taken out. Added up over all pairs, one
Gauss-Newton step says by how much each photo's focal length should change, and how well the pairs know it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.mapping.grading.pair_evidence import PairEvidence
from fieldstone.scene.match_graph import MatchGraph

PRIOR_SD = 0.5
"""Of the logarithm of a focal length: a lens is seldom off by more than a factor of 1.6."""
COMMON_VARIANCE = 0.01
"""Share of the variance of a pair's errors that its matches have in common: a tenth of their standard deviation."""
MEDIAN_CHI_SQUARE, LARGEST_CHI_SQUARE = 2.0 * float(np.log(2.0)), 9.21
"""Of a pair's two focal lengths: the median, and what one pair in a hundred exceeds by chance."""
ROUNDS = 5


@dataclass(frozen=True, eq=False)
class FocalEvidence:
    """Corrections of the logarithms of focal lengths, by photo; nan where no pair says anything."""

    change: Float[np.ndarray, "v"]
    sd: Float[np.ndarray, "v"]

    def significant(self, least: float, standard_errors: float) -> Bool[np.ndarray, "v"]:
        """Photos whose focal length should change by more than a share, beyond the scatter."""
        size = np.abs(self.change)
        return (size > least) & (size > standard_errors * self.sd)


def focal_evidence(pairs: Sequence[PairEvidence], graph: MatchGraph) -> FocalEvidence:
    """The step of the score test, and its standard deviations.

    Noise is not all that there is: errors of one pair have a part in common, of the lens, the shutter or the surface,
    which more matches do not average away (design effect). Pairs that share keypoints share their noise, so the
    information counts every keypoint once. Pairs that no step suits, such as false ones, lose their weight; where the
    others disagree with each other by more than all that, standard deviations grow by as much (Birge ratio).

    Source:
        `rao1948` (score test), `kish1965`, section 5.4 (design effect), `birge1932` (ratio). Departure: the ratio is
        of the median pair.
    """
    n = graph.num_images
    both = np.array([found.pair for found in pairs], dtype=np.int64).reshape(-1, 2)
    effect = 1.0 + COMMON_VARIANCE * (np.array([found.matches for found in pairs]) - 1.0)
    H = np.array([found.focal_information for found in pairs]).reshape(-1, 2, 2) / effect[:, None, None]
    g = np.array([found.focal_score for found in pairs]).reshape(-1, 2) / effect[:, None]
    change, sd = np.full(n, np.nan), np.full(n, np.nan)
    told = np.zeros(n, dtype=bool)
    told[both[np.trace(H, axis1=1, axis2=2) > 0]] = True
    if not told.any():
        return FocalEvidence(change, sd)
    weight, left, inverse = np.ones(len(pairs)), np.zeros(len(pairs)), np.linalg.pinv(H, hermitian=True)
    covariance, step = np.zeros((n, n)), np.zeros(n)
    for _ in range(ROUNDS):
        information, score = np.zeros((n, n)), np.zeros(n)
        rows, columns = both[:, :, None].repeat(2, axis=2), both[:, None, :].repeat(2, axis=1)
        np.add.at(information, (rows, columns), weight[:, None, None] * H)
        np.add.at(score, both, weight[:, None] * g)
        covariance = np.linalg.inv(information + np.eye(n) / PRIOR_SD**2)
        step = -covariance @ score
        after = g + np.einsum("pij,pj->pi", H, step[both])
        left = np.einsum("pi,pij,pj->p", after, inverse, after)
        weight = 1.0 / (1.0 + left / LARGEST_CHI_SQUARE)
    change[told] = step[told]
    birge = max(1.0, float(np.median(left)) / MEDIAN_CHI_SQUARE)
    sd[told] = np.sqrt(birge * uses_of_a_keypoint(pairs, graph) * np.diag(covariance)[told])
    return FocalEvidence(change, sd)


def uses_of_a_keypoint(pairs: Sequence[PairEvidence], graph: MatchGraph) -> float:
    """In how many pairs a keypoint is matched, on average over the matched ones."""
    uses, keypoints = 0, [np.zeros(len(k), dtype=bool) for k in graph.keypoints]
    for found in pairs:
        rows = graph.inlier_matches(found.pair)
        uses += 2 * len(rows)
        for side, photo in enumerate(found.pair):
            keypoints[photo][rows[:, side]] = True
    return uses / max(sum(int(k.sum()) for k in keypoints), 1)
