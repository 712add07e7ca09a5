"""One word for a finished model, with its reasons: good, weak or doubtful.

A low reprojection error says that a model agrees with itself. Cameras can bend until it does, and matches that do not
fit can be dropped. What is counted here are the matches that were there before, see `pair_evidence`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.mapping.grading.focal_evidence import focal_evidence
from fieldstone.mapping.grading.hold import hinges, weakly_held
from fieldstone.mapping.grading.options import GradingOptions, Limits
from fieldstone.mapping.grading.pair_evidence import PairEvidence, evidence_of_pairs
from fieldstone.records.mapping import Grade, GradeReason
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Reconstruction

logger = logging.getLogger(__name__)

HALF = 0.5
"""A photo of which pairs contradict more than half of the matches is in the wrong place."""


def grade_run(
    run: MappingRun,
    verified: MatchGraph,
    known: Bool[np.ndarray, "c"],
    options: GradingOptions,
    seed: int,
    threads: int,
) -> Grade:
    """The grade of the first model of a run.

    Args:
        verified: The matches as they were before any pair was taken to be false.
        known: Cameras whose intrinsics were given as exact.
    """
    model, graph = run.reconstruction, run.graph
    registered = model.registered()
    if len(registered) < 2:
        return _grade([GradeReason("doubtful", "no two photos are in one model", "take more photos that overlap")])
    pairs = pairs_to_ask(model, graph, options.max_pairs, np.random.default_rng([seed, len(registered)]))
    asked = evidence_of_pairs(model, graph, pairs, options.two_view, seed, threads)
    reasons = [*_of_size(model), *_of_false_pairs(run, verified, options), *_of_cameras(run, known, options)]
    if not asked:
        reasons.append(GradeReason("weak", "no pair of its photos has enough matches to be asked", "take more photos"))
        return _grade(reasons)
    table = _Table.of(asked, options)
    wanted = focal_evidence(asked, graph).significant(options.min_focal_change, options.standard_errors)
    wanted &= ~np.array([known[view.camera] for view in model.views])
    contradicted = [v for v in registered.tolist() if table.contradicts(v, options)]
    light, hinge = weakly_held(model, options.min_points), hinges(model, options.min_common_points)
    figures = {
        "pairs": len(asked),
        "matches_kept": 1.0 - table.lost,
        "error_added": table.error_added,
        "matches_denied": table.denied,
        "matches_turned": table.turned,
        "other_focal": _names(model, np.flatnonzero(wanted)),
        "contradicted": _names(model, contradicted),
        "weakly_held": _names(model, sorted({*light, *hinge})),
    }
    reasons += [
        *_of_matches(table, options),
        *_of_photos(figures["contradicted"], figures["other_focal"], len(registered), options),
        *_of_hold(_names(model, light), _names(model, sorted(hinge)), options),
    ]
    return _grade(reasons, **figures)


def pairs_to_ask(model: Reconstruction, graph: MatchGraph, max_pairs: int, rng: np.random.Generator) -> list[ImagePair]:
    """Verified pairs of registered photos, or a sample of them; where no pair was verified, those with matches."""
    is_registered = np.zeros(len(model.views), dtype=bool)
    is_registered[model.registered()] = True
    pairs = [
        pair
        for pair in sorted(graph.matches)
        if is_registered[list(pair)].all() and (not graph.two_views or _is_verified(graph, pair))
    ]
    if len(pairs) <= max_pairs:
        return pairs
    return [pairs[k] for k in np.sort(rng.choice(len(pairs), max_pairs, replace=False)).tolist()]


@dataclass(frozen=True, eq=False)
class _Table:
    """Evidence of all pairs by column; shares are weighted by matches."""

    pair: np.ndarray
    matches: Float[np.ndarray, "p"]
    kept: Float[np.ndarray, "p"]
    tension: Float[np.ndarray, "p"]
    turns: Bool[np.ndarray, "p"]

    @staticmethod
    def of(asked: Sequence[PairEvidence], options: GradingOptions) -> _Table:
        rotation, sd = (np.array([getattr(found, name) for found in asked]) for name in ("rotation", "rotation_sd"))
        return _Table(
            np.array([found.pair for found in asked]),
            np.array([found.matches for found in asked], dtype=np.float64),
            np.array([found.kept for found in asked]),
            np.array([found.tension for found in asked]),
            (rotation > np.deg2rad(options.min_turn_deg)) & (rotation > options.standard_errors * sd),
        )

    @property
    def lost(self) -> float:
        """Share of matches that the model does not explain."""
        return 1.0 - float(np.average(self.kept, weights=self.matches))

    @property
    def denied(self) -> float:
        """Share of matches in pairs that the model shows at different places."""
        return float(np.average(self.kept < HALF, weights=self.matches))

    @property
    def turned(self) -> float:
        """Share of matches in pairs that want another rotation."""
        return float(np.average(self.turns, weights=self.matches))

    @property
    def error_added(self) -> float:
        """Share of the variance that the model adds, at the median match."""
        order = np.argsort(self.tension, kind="stable")
        half = np.searchsorted(np.cumsum(self.matches[order]), 0.5 * self.matches.sum())
        return max(0.0, 1.0 - 1.0 / float(self.tension[order][half]) ** 2)

    def contradicts(self, view: int, options: GradingOptions) -> bool:
        """Whether the pairs of a photo do not fit where it is."""
        mine = (self.pair == view).any(axis=1)
        if not mine.any():
            return False
        own = _Table(self.pair[mine], self.matches[mine], self.kept[mine], self.tension[mine], self.turns[mine])
        return own.lost > HALF or own.turned > HALF or own.error_added > options.error_added.doubtful


def _of_size(model: Reconstruction) -> Iterator[GradeReason]:
    """Too few photos to check each other, or too few of all."""
    registered, photos = len(model.registered()), len(model.views)
    if registered == 2:
        yield GradeReason("weak", "two photos cannot check each other", "take more photos that overlap")
    elif registered < HALF * photos:
        yield GradeReason(
            "weak",
            f"{registered} of {photos} photos are in the first model",
            "look at the verdicts on the others; take photos that overlap with both parts",
        )


def _of_false_pairs(run: MappingRun, verified: MatchGraph, options: GradingOptions) -> Iterator[GradeReason]:
    """Pairs that agree on a geometry and were taken to be false, and models that explain the photos as well."""
    pairs = [pair for pair in verified.two_views if _is_verified(verified, pair)]
    gone = [pair for pair in pairs if not _is_verified(run.graph, pair)]
    if word := _word(len(gone) / max(len(pairs), 1), options.left_out):
        yield GradeReason(
            word,
            f"{len(gone)} of {len(pairs)} pairs were taken to be false, because places look alike",
            "compare the model with the place; photos between those that look alike settle it",
        )
    if run.alternative:
        yield GradeReason(
            "weak",
            "places look alike, and the photos do not tell which of two models is true: both are kept",
            "compare both with the place, or add photos of what is around",
        )


def _of_cameras(run: MappingRun, known: Bool[np.ndarray, "c"], options: GradingOptions) -> Iterator[GradeReason]:
    """Cameras that the photos hardly determine, and cameras as nobody builds them."""
    model = run.reconstruction
    photos = [model.views[v].camera for v in model.registered().tolist()]
    vague = [c for c in photos if not known[c] and _is_vague(run, c, options.max_focal_sd)]
    if word := _word(len(vague) / len(photos), options.uncertain_cameras):
        yield GradeReason(
            word,
            f"the cameras of {len(vague)} of {len(photos)} photos are not well determined: "
            f"{run.certainties[vague[0]].reason}",
            "give the intrinsics, or take more photos with each camera, also turned by a right angle",
        )
    for c in sorted(set(photos)):
        fx, fy = model.cameras[c].focal
        if (word := _word(abs(fx / fy - 1.0), options.max_pixel_ratio)) and not known[c]:
            yield GradeReason(
                word,
                f"camera {c} has pixels that are not square: fx {fx:.6g}, fy {fy:.6g}",
                "give its intrinsics, or check that the photos come from an ordinary lens and were not stretched",
            )


def _is_vague(run: MappingRun, camera: int, max_focal_sd: float) -> bool:
    """Whether a focal length was guessed, or is known to no better than a share of it."""
    if camera >= len(run.certainties):
        return False
    certainty, params = run.certainties[camera], run.reconstruction.cameras[camera].params
    sd = certainty.sds[0] if certainty.sds else None
    return certainty.word == "assumed" if sd is None else sd > max_focal_sd * float(params[0])


def _of_matches(table: _Table, options: GradingOptions) -> Iterator[GradeReason]:
    """What all pairs together say. What is off by every measure is doubtful, though it be far off by none."""
    advice = "check that photos of one camera share zoom and lens, that nothing in them stands still, and their EXIF"
    if word := _word(table.error_added, options.error_added):
        yield GradeReason(word, f"{table.error_added:.0%} of the matches' error is the model's, not theirs", advice)
    if word := _word(table.lost, options.lost):
        yield GradeReason(word, f"{table.lost:.0%} of the matches do not fit the model", advice)
    if word := _word(table.denied, options.denied):
        reason = f"{table.denied:.0%} of the matches join photos that the model shows at different places"
        yield GradeReason(word, reason, "look for places that look alike, and for parts of the model upon each other")
    if word := _word(table.turned, options.turned):
        reason = f"{table.turned:.0%} of the matches want their photos turned by over {options.min_turn_deg:g} degrees"
        yield GradeReason(word, reason, advice)
    shares = (table.error_added, table.lost, table.denied, table.turned)
    limits = (options.error_added, options.lost, options.denied, options.turned)
    if all(map(_word, shares, limits)):
        yield GradeReason("doubtful", "by every measure the matches speak against the model", advice)


def _of_photos(
    contradicted: Sequence[str], other_focal: Sequence[str], registered: int, options: GradingOptions
) -> Iterator[GradeReason]:
    """Photos that stand out."""
    if word := _word(len(contradicted) / registered, options.contradicted):
        yield GradeReason(
            word,
            f"{_counted(contradicted)} in a place that its pairs contradict",
            "leave it out, or take others like it",
        )
    if word := _word(len(other_focal) / registered, options.other_focal):
        yield GradeReason(
            word,
            f"{_counted(other_focal)} with pairs that want another focal length",
            "check whether it was taken with another lens or zoom, or was cropped",
        )


def _of_hold(light: Sequence[str], hinge: Sequence[str], options: GradingOptions) -> Iterator[GradeReason]:
    """Photos that are weakly held, and those that hold the model together."""
    if light:
        reason = f"{_counted(light)} held by fewer than {options.min_points} points"
        yield GradeReason("weak", reason, "take photos between it and its neighbours")
    if hinge:
        reason = f"the model hangs together by {_counted(hinge)} alone"
        yield GradeReason("weak", reason, "take more photos where its parts meet")


def _grade(reasons: Sequence[GradeReason], **figures) -> Grade:
    ordered = tuple(sorted(reasons, key=lambda reason: reason.word != "doubtful"))
    grade = Grade(ordered[0].word if ordered else "good", ordered, **figures)
    logger.info("grade %s%s", grade.word, "".join(f"; {reason.reason}" for reason in ordered))
    return grade


def _word(value: float, limits: Limits):
    """What a number makes of the grade; None for nothing."""
    return "doubtful" if value > limits.doubtful else "weak" if value > limits.weak else None


def _is_verified(graph: MatchGraph, pair: ImagePair) -> bool:
    two_view = graph.two_views.get(pair)
    return two_view is not None and bool(two_view.inliers.any())


def _names(model: Reconstruction, views: Sequence[int] | np.ndarray) -> tuple[str, ...]:
    return tuple(model.views[int(v)].name for v in views)


def _counted(names: Sequence[str]) -> str:
    """How many photos, and the first few names."""
    shown = ", ".join(names[:3])
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{len(names)} {'photo' if len(names) == 1 else 'photos'} ({shown}{more})"
