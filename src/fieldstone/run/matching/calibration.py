"""Focal lengths before photos are mapped, and which photos share a camera: what headers say, and pairs agree to."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.features.verification import UncalibratedPairs, misfits, uncalibrated_pairs, voting_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.run.matching.camera_sharing import Grouping, finer_groupings
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photo_cameras import GUESSED_FOCAL, SIGMA_OF_SOURCE, FocalSource, PhotoCameras
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.averaging.focal_lengths import FocalPrior, agreement
from fieldstone.solve.robust.focal_voting import vote_focal_of_rotations

logger = logging.getLogger(__name__)

MAX_PAIRS, PAIRS_PER_PHOTO = 300, 4
"""Pairs that are asked where some focal length is unknown."""
MAX_PAIRS_TO_CHECK_EXIF, PAIRS_PER_PHOTO_TO_CHECK_EXIF = 30, 3
MAX_JUDGES = 100
"""Pairs whose matches decide between two sets of focal lengths."""
CHANGED_FOCAL = 0.02
"""Pairs of photos whose focal lengths change by a smaller share judge nothing."""
SIGNIFICANT = 2.5
"""Standard errors by which matches must fit better without EXIF, unless most pairs agree: then better is enough."""
TOLERATED = -1.0
"""Standard errors by which they may fit worse with cameras apart: the evidence of the pairs is for it then."""
MOST = 0.6
"""Share of the pairs that agree on focal lengths which nobody need doubt."""
SINGLE_PHOTOS = 2
"""EXIF of cameras with so few photos is doubted for all of them together."""
ROTATION_SIGMA = 0.05
"""Relative standard deviation of the focal length that a turning camera gives."""
MAX_LINES, MAX_NAMES = 3, 3
"""More than so many cameras with false EXIF are told of in one line, which names so many photos."""
VAGUE = 0.2
"""A focal length that pairs leave open by this share is not known."""


@dataclass(frozen=True, eq=False)
class _Case:
    """What calibration is about."""

    graph: MatchGraph
    known: PhotoCameras
    pairs: UncalibratedPairs
    options: MatchingOptions
    seed: int

    def cameras(self, grouping: Grouping) -> list[Camera]:
        """Of every group: that of its photos, with the focal length of the estimate."""
        _, first = np.unique(grouping.group, return_index=True)
        before = [self.known.cameras[c] for c in self.known.camera_of_image[first]]
        focals = np.exp(grouping.estimate.log_focal)
        return [
            replace(camera, params=np.array([f * max(camera.width, camera.height), *camera.principal_point]))
            for f, camera in zip(focals, before, strict=True)
        ]

    def significance(self, before: Grouping, after: Grouping, photos: Bool[np.ndarray, "n"]) -> float:
        """By how many standard errors the matches of pairs with one of these photos fit better after than before.

        Of square roots of misfits: a misfit is a sum of small terms, and varies as a count does.
        """
        changed = photos & (np.abs(after.log_focal - before.log_focal) > CHANGED_FOCAL)
        pairs = [pair for pair in self.pairs.inliers if changed[pair[0]] or changed[pair[1]]]
        pairs = sorted(pairs, key=lambda pair: (-self.pairs.inliers[pair], pair))[:MAX_JUDGES]
        if len(pairs) < 2:
            return 0.0
        options = self.options
        misfit = [
            misfits(self.graph, pairs, self.cameras(g), g.group, options.two_view, self.seed, options.threads)
            for g in (before, after)
        ]
        gain = np.sqrt(misfit[0]) - np.sqrt(misfit[1])
        error = float(gain.std(ddof=1)) / np.sqrt(len(gain))
        logger.info(
            "focal lengths of %d photos: the misfit of %d pairs falls from %.0f to %.0f, %.1f standard errors",
            changed.sum(), len(pairs), misfit[0].sum(), misfit[1].sum(), gain.mean() / max(error, 1e-300),
        )  # fmt: skip
        return float(gain.mean() / max(error, 1e-300))

    def needed(self, after: Grouping, photos: Bool[np.ndarray, "n"]) -> float:
        """Standard errors by which the matches of these photos must fit better to do without EXIF."""
        evidence = self.pairs.parallax
        touched = photos[evidence.pairs].any(axis=1)
        agree = agreement(evidence, after.log_focal)[touched]
        return 0.0 if len(agree) and agree.mean() > MOST else SIGNIFICANT


def calibrate(
    graph: MatchGraph,
    known: PhotoCameras,
    folder: Int[np.ndarray, "n"],
    options: MatchingOptions,
    seed: int,
) -> tuple[PhotoCameras, list[str]]:
    """Focal lengths as the pairs among all photos see them, and cameras apart where photos do not share one.

    What EXIF states is a prior of its own width. It is dropped where the pairs contradict it and, without it, matches
    fit significantly better. Photos that share a camera get cameras of their own where that makes the pairs more
    probable, and their matches fit no worse.

    Args:
        folder: Number of every photo's folder: those in one may share a camera.

    Returns:
        The cameras, and one line on every decision that headers do not make.
    """
    if all(source == "given" for source in known.source):
        return known, []
    unknown = "guess" in known.source
    budget = (MAX_PAIRS, PAIRS_PER_PHOTO) if unknown else (MAX_PAIRS_TO_CHECK_EXIF, PAIRS_PER_PHOTO_TO_CHECK_EXIF)
    asked = voting_pairs(graph, *budget)
    pairs = uncalibrated_pairs(
        graph, asked, known.cameras, known.camera_of_image, options.two_view, seed, options.threads
    )
    case = _Case(graph, known, pairs, options, seed)
    stated = _prior(case)
    grouping, doubted = _without_false_exif(case, stated)
    if options.cameras == "auto":
        grouping = _with_cameras_apart(case, grouping, stated, doubted, folder)
    return _told(case, grouping)


def _prior(case: _Case) -> FocalPrior:
    """What is known of each camera: what EXIF states, what a turning camera tells, or what is usual."""
    known, pairs = case.known, case.pairs
    longer = np.array([max(camera.width, camera.height) for camera in known.cameras])
    stated = np.log([camera.focal.mean() for camera in known.cameras] / longer)
    stated[[source != "exif" for source in known.source]] = np.nan
    mean, sigma = np.full(len(stated), np.log(GUESSED_FOCAL)), np.full(len(stated), SIGMA_OF_SOURCE["guess"])
    parallax = [(int(i), int(j)) for i, j in pairs.parallax.pairs]
    for c in range(len(stated)):
        own = [p for p in pairs.inliers if known.camera_of_image[p[0]] == known.camera_of_image[p[1]] == c]
        turning = [(H, pairs.inliers[p]) for p, H in pairs.turning if p in own]
        if sum(n for _, n in turning) <= sum(pairs.inliers[p] for p in parallax if p in own):
            continue
        focal = vote_focal_of_rotations(np.array([H for H, _ in turning]), np.array([float(n) for _, n in turning]))
        if focal is not None:
            mean[c], sigma[c] = np.log(focal), ROTATION_SIGMA
            if abs(mean[c] - stated[c]) > VAGUE:
                stated[c] = np.nan
    return FocalPrior(mean, sigma, stated)


def _firm(prior: FocalPrior) -> FocalPrior:
    """The prior with what is stated taken at its word, within its own width."""
    stated = ~np.isnan(prior.stated)
    return FocalPrior(
        np.where(stated, prior.stated, prior.mean),
        np.where(stated, SIGMA_OF_SOURCE["exif"], prior.sigma),
        np.full(len(stated), np.nan),
    )


def _silent(prior: FocalPrior, where: Bool[np.ndarray, "g"]) -> FocalPrior:
    """The prior with nothing stated for some groups."""
    return replace(prior, stated=np.where(where, np.nan, prior.stated))


def _without_false_exif(case: _Case, stated: FocalPrior) -> tuple[Grouping, Bool[np.ndarray, "c"]]:
    """Focal lengths with what EXIF states as a prior, except where it is false; and whose EXIF was doubted.

    A camera's EXIF is doubted if the pairs make another focal length more probable. It is false if matches then fit
    better than with EXIF at its word; photos that are alone with their EXIF are judged together.
    """
    evidence, group = case.pairs.parallax, case.known.camera_of_image
    firm = Grouping.of(evidence, group, _firm(stated))
    if np.isnan(stated.stated).all():
        return firm, np.zeros(len(stated.mean), dtype=bool)
    soft = Grouping.of(evidence, group, stated)
    doubted = ~np.isnan(stated.stated) & (stated.belief(soft.estimate.log_focal) < 0.5)
    if not doubted.any():
        return firm, doubted
    at_its_word = replace(
        firm.estimate, log_focal=np.where(np.isnan(stated.stated), firm.estimate.log_focal, stated.stated)
    )
    before = replace(firm, estimate=at_its_word)
    free = Grouping.of(evidence, group, _firm(_silent(stated, doubted)), soft.estimate.log_focal)
    large = np.bincount(group, minlength=len(doubted)) > SINGLE_PHOTOS
    false = np.zeros(len(doubted), dtype=bool)
    for judged in [*np.eye(len(doubted), dtype=bool)[doubted & large], doubted & ~large]:
        if judged.any() and case.significance(before, free, judged[group]) > case.needed(free, judged[group]):
            false |= judged
    if not false.any():
        return firm, doubted
    start = np.where(false, free.estimate.log_focal, firm.estimate.log_focal)
    return Grouping.of(evidence, group, _firm(_silent(stated, false)), start), doubted


def _with_cameras_apart(
    case: _Case, grouping: Grouping, stated: FocalPrior, doubted: Bool[np.ndarray, "c"], folder: Int[np.ndarray, "n"]
) -> Grouping:
    """The finest grouping that the pairs ask for and their matches agree to.

    Where it leaves what EXIF states of some photos, matches have to fit significantly better.
    """
    # EXIF that nobody doubts for all photos of a camera may still be wrong for some of them.
    believed = ~np.isnan(stated.stated) & ~doubted
    start = grouping
    if believed.any():
        prior = FocalPrior(
            np.where(believed, stated.mean, grouping.prior.mean),
            np.where(believed, stated.sigma, grouping.prior.sigma),
            np.where(believed, stated.stated, np.nan),
        )
        start = Grouping.of(case.pairs.parallax, grouping.group, prior, grouping.estimate.log_focal)
    for finer in reversed(list(finer_groupings(case.pairs.parallax, start, folder))):
        leaves_exif = ~np.isnan(finer.prior.stated) & (finer.prior.belief(finer.estimate.log_focal) < 0.5)
        needed = case.needed(finer, leaves_exif[finer.group]) if leaves_exif.any() else TOLERATED
        if case.significance(grouping, finer, np.ones(len(folder), dtype=bool)) > needed:
            return finer
    return grouping


def _told(case: _Case, grouping: Grouping) -> tuple[PhotoCameras, list[str]]:
    """The cameras of a grouping, and what is to be told of them."""
    known, estimate = case.known, grouping.estimate
    _, first = np.unique(grouping.group, return_index=True)
    origin = known.camera_of_image[first]
    longer = np.array([max(known.cameras[c].width, known.cameras[c].height) for c in origin])
    header = np.array([known.cameras[c].focal.mean() for c in origin]) / longer
    source: list[FocalSource] = []
    for g, c in enumerate(origin):
        near = abs(estimate.log_focal[g] - np.log(header[g])) < SIGNIFICANT * SIGMA_OF_SOURCE["exif"]
        believed = known.source[c] == "exif" and near
        source.append("exif" if believed else "guess" if estimate.sigma[g] > VAGUE else "photos")
    false_exif = np.array([known.source[c] == "exif" != s for c, s in zip(origin, source, strict=True)])
    vague = np.array([s == "guess" for s in source])
    ratios = np.exp(estimate.log_focal)
    notes = [
        *_of_false_exif(case, grouping, header, np.flatnonzero(false_exif)),
        *_of_unknown(ratios, vague[grouping.group], grouping.group),
        *(_of_cameras_apart(ratios[origin == c], int(np.sum(known.camera_of_image == c))) for c in _repeated(origin)),
    ]
    for note in notes:
        logger.warning("%s", note)
    return PhotoCameras(tuple(case.cameras(grouping)), grouping.group, tuple(source)), notes


def _repeated(values: Int[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    unique, count = np.unique(values, return_counts=True)
    return unique[count > 1]


def _of_false_exif(case: _Case, grouping: Grouping, header, groups: Int[np.ndarray, "k"]) -> list[str]:
    """One line on every camera whose EXIF is not used, or one on all, if they are many."""

    def names(photos: Bool[np.ndarray, "n"]) -> str:
        some = [case.graph.names[k] for k in np.flatnonzero(photos)[:MAX_NAMES]]
        return ", ".join(some) + (", ..." if photos.sum() > MAX_NAMES else "")

    if len(groups) > MAX_LINES:
        photos = np.isin(grouping.group, groups)
        return [
            f"EXIF of {photos.sum()} photos states focal lengths that the photos contradict: not used ({names(photos)})"
        ]
    out = []
    for g in groups:
        photos = grouping.group == g
        out.append(
            f"EXIF states a focal length of {header[g]:.2f} times the longer side, the photos agree on "
            f"{np.exp(grouping.estimate.log_focal[g]):.2f}: EXIF is not used"
            + ("" if photos.all() else f" ({names(photos)})")
        )
    return out


def _of_unknown(ratios, vague: Bool[np.ndarray, "n"], group: Int[np.ndarray, "n"]) -> list[str]:
    """One line, if the focal lengths of some photos remain a guess."""
    if not vague.any():
        return []
    count = int(vague.sum())
    which = "focal length" if vague.all() else f"focal length of {count} photo{'s' if count > 1 else ''}"
    about = np.median(ratios[group[vague]])
    return [f"{which} unknown, and the photos do not tell: about {about:.2f} times the longer side, guessed"]


def _of_cameras_apart(ratios: Float[np.ndarray, "k"], num_photos: int) -> str:
    return (
        f"{num_photos} photos that might share a camera are of {len(ratios)} cameras: "
        f"focal lengths from {ratios.min():.2f} to {ratios.max():.2f} times the longer side"
    )
