"""The pair that a sub-model begins with: many matches, wide rays, and points that survive bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.camera import plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.triangulation import in_front_of_both, triangulate_linear, triangulation_angles
from fieldstone.mapping.incremental.options import IncrementalOptions, RetryStage
from fieldstone.mapping.model.refinement import adjust_globally
from fieldstone.mapping.model.triangulation import retriangulate
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph

BEST_ANGLE_DEG = 20.0
"""Wider rays than these make a start no better."""
ANGLE_SAMPLES = 200
"""Matches of a pair whose angles are looked at."""


@dataclass(frozen=True, eq=False)
class InitialPairCandidate:
    """A pair to start from: score (higher is better), and how many points at which median angle."""

    pair: ImagePair
    cam2_from_cam1: Rigid3
    score: float
    num_points: int
    median_angle: float


def rank_initial_pairs(
    graph: MatchGraph, model: WorkingModel, available: Bool[np.ndarray, "n"], stage: RetryStage, count: int
) -> list[InitialPairCandidate]:
    """The `count` best pairs of available photos from which a model can start, best first.

    The score is the number of points in front of both cameras times the sine of their median angle, up to
    BEST_ANGLE_DEG: many matches make a stable pose, wide rays make stable points. Pairs are looked at in the order of
    their inliers, until no other can have a better score.
    """
    candidates: list[InitialPairCandidate] = []
    inliers = {pair: int(two_view.inliers.sum()) for pair, two_view in graph.two_views.items()}
    best_sine = np.sin(np.deg2rad(BEST_ANGLE_DEG))
    for pair in sorted(inliers, key=lambda pair: (-inliers[pair], pair)):
        if len(candidates) >= count and inliers[pair] * best_sine < candidates[count - 1].score:
            break
        if not (available[pair[0]] and available[pair[1]]):
            continue
        candidate = _candidate(graph, model, pair, inliers[pair], stage)
        if candidate is not None:
            candidates.append(candidate)
            candidates.sort(key=lambda candidate: (-candidate.score, candidate.pair))
    return candidates[:count]


def initialize(
    empty: WorkingModel, candidate: InitialPairCandidate, stage: RetryStage, options: IncrementalOptions
) -> WorkingModel | None:
    """Two posed views and their points after bundle adjustment; None if too few points remain."""
    i, j = candidate.pair
    model = empty.with_pose(i, Rigid3.identity()).with_pose(j, candidate.cam2_from_cam1)
    limits = {"max_error_px": options.max_error_px, "min_angle_deg": stage.min_angle_deg}
    for _ in range(2):
        model = retriangulate(model, model.all_tracks(), **limits)
        if model.is_point().sum() < stage.min_initial_points // 2:
            return None
        model = adjust_globally(model, options.refinement, (None,) * len(model.cameras))
    return retriangulate(model, model.all_tracks(), **limits)


def _candidate(
    graph: MatchGraph, model: WorkingModel, pair: ImagePair, inliers: int, stage: RetryStage
) -> InitialPairCandidate | None:
    """The pair with its score; None if its geometry, its points or their angle do not reach what the stage asks."""
    two_view = graph.two_views[pair]
    if two_view.cam2_from_cam1 is None or two_view.kind not in ("calibrated", "planar"):
        return None
    if inliers < stage.min_initial_points:
        return None
    angles, in_front = _angles(graph, model, pair, two_view.cam2_from_cam1)
    num_points = int(in_front * inliers)
    if num_points < stage.min_initial_points or np.median(angles) < np.deg2rad(stage.min_initial_angle_deg):
        return None
    median = float(np.median(angles))
    score = num_points * np.sin(min(median, np.deg2rad(BEST_ANGLE_DEG)))
    return InitialPairCandidate(pair, two_view.cam2_from_cam1, float(score), num_points, median)


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
