"""A pose for one more photo, and the start of a model from a pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between
from fieldstone.geometry.triangulation import in_front_of_both, triangulate_linear, triangulation_angles
from fieldstone.mapping.disambiguation.rotation_forest import AGREE
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.solve.robust.absolute_pose import estimate_absolute_pose
from fieldstone.solve.robust.ransac import RansacOptions

BEST_START_ANGLE_DEG = 20.0
"""Wider rays than these make a start no better."""
MAX_DOUBT = 0.2
"""Larger shares of matches that contradict a model tell of wrong cameras: false pairs were taken out before."""
ANGLE_SAMPLES = 200
"""Matches of a pair whose angles are looked at."""


@dataclass(frozen=True, eq=False)
class Start:
    """A pair to start from: score (higher is better), and how many points at which median angle."""

    pair: ImagePair
    cam2_from_cam1: Rigid3
    score: float
    num_points: int
    median_angle: float


def rank_starts(
    graph: MatchGraph,
    model: WorkingModel,
    usable: Sequence[bool] | np.ndarray,
    min_angle_deg: float,
    min_points: int,
    count: int,
) -> list[Start]:
    """The `count` best pairs of usable photos from which a model can start, best first.

    The score is the number of points in front of both cameras times the sine of their median angle, up to
    BEST_START_ANGLE_DEG: many matches make a stable pose, wide rays make stable points. Pairs are looked at in the
    order of their inliers, until no other can have a better score.
    """
    starts: list[Start] = []
    inliers = {pair: int(two_view.inliers.sum()) for pair, two_view in graph.two_views.items()}
    best_sine = np.sin(np.deg2rad(BEST_START_ANGLE_DEG))
    for pair in sorted(inliers, key=lambda pair: (-inliers[pair], pair)):
        if len(starts) >= count and inliers[pair] * best_sine < starts[count - 1].score:
            break
        two_view = graph.two_views[pair]
        if two_view.cam2_from_cam1 is None or not (usable[pair[0]] and usable[pair[1]]):
            continue
        if two_view.kind not in ("calibrated", "planar") or inliers[pair] < min_points:
            continue
        angles, share = _angles(graph, model, pair, two_view.cam2_from_cam1)
        num_points = int(share * inliers[pair])
        if num_points < min_points or np.median(angles) < np.deg2rad(min_angle_deg):
            continue
        median = float(np.median(angles))
        score = num_points * np.sin(min(median, np.deg2rad(BEST_START_ANGLE_DEG)))
        starts.append(Start(pair, two_view.cam2_from_cam1, float(score), num_points, median))
        starts.sort(key=lambda start: (-start.score, start.pair))
    return starts[:count]


@dataclass(frozen=True, eq=False)
class Registration:
    """Outcome of one attempt: the pose, or None, and the numbers that decided."""

    cam_from_world: Rigid3 | None
    num_inliers: int
    num_points: int

    def reason(self) -> str:
        """For the verdict on the photo."""
        return f"{self.num_inliers} of {self.num_points} points agree with one pose"


def register_view(
    model: WorkingModel, view: int, options: RansacOptions, min_inliers: int, rng: np.random.Generator
) -> Registration:
    """The pose of a photo from the points that it sees."""
    rows = model.observations_of(view)
    if len(rows) < max(min_inliers, 3):
        return Registration(None, 0, len(rows))
    found = estimate_absolute_pose(
        model.camera_of(view), model.tracks.pixels[rows], model.xyz[model.tracks.point[rows]], options, rng
    )
    if found is None or found.inliers.sum() < min_inliers:
        return Registration(None, 0 if found is None else int(found.inliers.sum()), len(rows))
    return Registration(found.cam_from_world, int(found.inliers.sum()), len(rows))


def contradicts_pairs(model: WorkingModel, graph: MatchGraph, view: int, cam_from_world: Rigid3) -> str:
    """Why a pose of a photo cannot be, or an empty text.

    Most matches with registered photos ask for another rotation, or there are none: where a scene repeats itself, a
    few false matches turn the points of one place into those of another. Where many matches among the registered
    photos do so, pairs say nothing: their rotations come from cameras that the model has since refined.
    """
    partners = _registered_partners(model, graph, view)
    if not partners:
        return "none of its photos has matches with this one"
    agree, differ = _agreement(model, graph, view, cam_from_world, partners)
    if differ <= agree:
        return ""
    registered = np.flatnonzero(model.registered_mask()).tolist()
    of_others = [
        _agreement(model, graph, v, model.pose_of(v), _registered_partners(model, graph, v)) for v in registered
    ]
    all_agree, all_differ = np.sum(of_others, axis=0)
    if all_differ > MAX_DOUBT * (all_agree + all_differ):
        return ""
    return f"{differ} of {agree + differ} matches with its photos ask for another rotation"


def _registered_partners(model: WorkingModel, graph: MatchGraph, view: int) -> list[int]:
    """Registered photos that a photo has verified matches with."""
    partners = [j if view == i else i for i, j in graph.two_views if view in (i, j)]
    return [p for p in partners if model.poses[p] is not None and _two_view(graph, view, p).inliers.any()]


def _two_view(graph: MatchGraph, a: int, b: int) -> TwoView:
    return graph.two_views[min(a, b), max(a, b)]


def _agreement(
    model: WorkingModel, graph: MatchGraph, view: int, cam_from_world: Rigid3, partners: Sequence[int]
) -> tuple[int, int]:
    """Matches of pairs that agree with a photo's rotation, or tell nothing of it; and of those that do not."""
    agree, differ = 0, 0
    for partner in partners:
        two_view = _two_view(graph, view, partner)
        pose, inliers = two_view.cam2_from_cam1, int(two_view.inliers.sum())
        R = None if pose is None else (pose.R if view > partner else pose.R.T) @ model.pose_of(partner).R
        if R is None or angle_between(R, cam_from_world.R) < AGREE:
            agree += inliers
        else:
            differ += inliers
    return agree, differ


def verdict_of_pairs(graph: MatchGraph, view: int) -> str:
    """What is known of a photo that no model took in: its best partner and how many matches agree."""
    partners: Mapping[str, int] = {
        graph.names[pair[0] if pair[1] == view else pair[1]]: int(two_view.inliers.sum())
        for pair, two_view in sorted(graph.two_views.items())
        if view in pair
    }
    features = len(graph.keypoints[view])
    if not partners or max(partners.values()) == 0:
        return f"no photo shares enough of its {features} features"
    best = max(partners, key=lambda name: partners[name])
    kinds = {two_view.kind for pair, two_view in graph.two_views.items() if view in pair and two_view.inliers.any()}
    turned = ", the camera only turned between its photos: no depth" if kinds == {"panoramic"} else ""
    return f"best partner {best} with {partners[best]} matches that agree, of {features} features{turned}"


def _angles(
    graph: MatchGraph, model: WorkingModel, pair: ImagePair, cam2_from_cam1: Rigid3
) -> tuple[Float[np.ndarray, "n"], float]:
    """Triangulation angles of a sample of the pair's inliers, and the share that lies in front of both cameras."""
    matches = graph.inlier_matches(pair)
    matches = matches[:: max(1, len(matches) // ANGLE_SAMPLES)]
    pixels1, pixels2 = graph.matched_pixels(pair, matches)
    uv1 = plane_from_image(model.camera_of(pair[0]), pixels1)
    uv2 = plane_from_image(model.camera_of(pair[1]), pixels2)
    uv = np.stack([uv1, uv2], axis=1)
    points = triangulate_linear(Rigid3.stack([Rigid3.identity(), cam2_from_cam1]), uv[np.isfinite(uv).all(axis=(1, 2))])
    ahead = points[in_front_of_both(cam2_from_cam1, points)]
    angles = triangulation_angles(np.zeros(3), cam2_from_cam1.target_origin_in_source(), ahead)
    return angles, len(ahead) / max(len(matches), 1)
