"""Which photos share a camera: a question for the pairs among them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.solve.averaging.focal_lengths import (
    FocalEstimate,
    FocalPrior,
    PairEvidence,
    estimate_focals,
    log_likelihood_of_photos,
)

SMALLEST_DIFFERENCE = 0.05
"""Cameras whose focal lengths differ by a smaller share may as well be one: focusing changes it as much."""
COST_OF_CAMERA = 2.0
"""Logarithm of the odds against one more camera: photos of one size and one EXIF body start as those of one."""
COST_OF_SPLIT = 3.0
"""And against there being more than one at all."""
MAX_PARTS = 4
"""Into how many parts a group is split at once, if not into its photos; parts are split again."""
REASSIGNMENTS = 5


@dataclass(frozen=True, eq=False)
class Grouping:
    """Which photos share a camera, what was known of its focal length, and what pairs say of it."""

    group: Int[np.ndarray, "n"]
    prior: FocalPrior
    estimate: FocalEstimate

    @staticmethod
    def of(
        evidence: PairEvidence,
        group: Int[np.ndarray, "n"],
        prior: FocalPrior,
        start: Float[np.ndarray, "g"] | None = None,
    ) -> Grouping:
        """Focal lengths for this grouping, see `estimate_focals`."""
        return Grouping(group, prior, estimate_focals(evidence, group, prior, start))

    @property
    def num_groups(self) -> int:
        """Number of cameras."""
        return len(self.prior.mean)

    @property
    def log_focal(self) -> Float[np.ndarray, "n"]:
        """Of every photo."""
        return self.estimate.log_focal[self.group]


def finer_groupings(evidence: PairEvidence, grouping: Grouping, hint: Int[np.ndarray, "n"]) -> Iterator[Grouping]:
    """More and more probable groupings, each of which splits a group of the one before.

    A group is split in a few parts, by the hint, or into its photos, whichever raises the evidence of all pairs most,
    if that is by more than the further cameras cost; parts are split again.

    Args:
        hint: Of every photo, a number that photos of one camera may have in common, such as that of its folder.
    """
    seen = np.zeros(len(grouping.group), dtype=bool)
    seen[np.unique(evidence.pairs)] = True
    waiting = list(range(grouping.num_groups))
    while waiting:
        g = waiting.pop()
        if np.sum(seen & (grouping.group == g)) < 2:
            continue
        finer = _best_split(evidence, grouping, g, hint)
        if finer is not None:
            waiting += [g, *range(grouping.num_groups, finer.num_groups)]
            grouping = finer
            yield grouping


def _best_split(evidence: PairEvidence, grouping: Grouping, g: int, hint: Int[np.ndarray, "n"]) -> Grouping | None:
    """The most probable split of group g; None if g as it is is more probable."""
    members = np.flatnonzero(grouping.group == g)

    def gain(finer: Grouping) -> float:
        more = finer.num_groups - grouping.num_groups
        return finer.estimate.log_evidence - grouping.estimate.log_evidence - COST_OF_SPLIT - COST_OF_CAMERA * more

    apart = _split(
        evidence, grouping, g, np.arange(len(members)), np.full(len(members), grouping.estimate.log_focal[g])
    )
    candidates = [apart]
    if np.ptp(hint[members]):
        candidates.append(_split(evidence, grouping, g, hint[members], apart.log_focal[members]))
    for parts in range(2, min(MAX_PARTS, len(members) - 1) + 1):
        candidates.append(_in_parts(evidence, grouping, g, apart, parts))
        if max(map(gain, candidates)) <= 0:
            return None
    best = max(candidates, key=gain)
    return best if gain(best) > 0 and np.ptp(best.log_focal[members]) > SMALLEST_DIFFERENCE else None


def _in_parts(evidence: PairEvidence, grouping: Grouping, g: int, apart: Grouping, parts: int) -> Grouping:
    """Group g cut where the focal lengths of its photos differ most, then every photo where it fits best.

    Args:
        apart: The photos of the group on their own.
    """
    members = np.flatnonzero(grouping.group == g)
    y = apart.log_focal[members]
    part = _cut(y, apart.estimate.sigma[apart.group[members]] ** -2.0, parts)
    best = _split(evidence, grouping, g, part, y)
    for _ in range(REASSIGNMENTS):
        values = [float(best.estimate.log_focal[k]) for k in (g, *range(grouping.num_groups, best.num_groups))]
        fits = np.array([log_likelihood_of_photos(evidence, best.log_focal, members, value) for value in values])
        moved = np.where(fits.max(axis=0) > fits[part, np.arange(len(members))], fits.argmax(axis=0), part)
        if len(np.unique(moved)) < parts or (moved == part).all():
            break
        part = moved
        other = _split(evidence, grouping, g, part, best.log_focal[members])
        if other.estimate.log_evidence <= best.estimate.log_evidence:
            break
        best = other
    return best


def _split(
    evidence: PairEvidence,
    grouping: Grouping,
    g: int,
    part: Int[np.ndarray, "m"],
    log_focal: Float[np.ndarray, "m"],
) -> Grouping:
    """The photos of group g in parts: that with the smallest number keeps g, the others come after all groups.

    Args:
        log_focal: Of the photos of the group, to start from.
    """
    _, part = np.unique(part, return_inverse=True)
    group = grouping.group.copy()
    group[grouping.group == g] = np.where(part == 0, g, grouping.num_groups + part - 1)
    origin = np.append(np.arange(grouping.num_groups), np.full(part.max(), g))
    means = np.bincount(part, log_focal) / np.bincount(part)
    start = np.append(grouping.estimate.log_focal, means[1:])
    start[g] = means[0]
    return Grouping.of(evidence, group, grouping.prior.of(origin), start)


def _cut(values: Float[np.ndarray, "m"], weights: Float[np.ndarray, "m"], parts: int) -> Int[np.ndarray, "m"]:
    """Numbers of parts of a line, each cut off where that lowers the weighted variance within parts most."""
    order = np.argsort(values, kind="stable")
    y, w = values[order], weights[order]
    part = np.zeros(len(y), dtype=np.int64)
    for number in range(1, parts):
        gains = np.zeros(len(y))
        for k in range(number):
            inside = np.flatnonzero(part == k)
            left_w, left_y = np.cumsum(w[inside])[:-1], np.cumsum((w * y)[inside])[:-1]
            right_w, right_y = w[inside].sum() - left_w, (w * y)[inside].sum() - left_y
            # The variance within falls by that between the two means.
            between = left_w * right_w / (left_w + right_w) * (left_y / left_w - right_y / right_w) ** 2
            gains[inside[1:]] = between
        start = int(np.argmax(gains))
        part[(part == part[start]) & (np.arange(len(y)) >= start)] = number
    out = np.empty(len(values), dtype=np.int64)
    out[order] = part
    return out
