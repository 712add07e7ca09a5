"""Which pairs a model agrees with: whether the points of one photo appear in the other where the matches say.

The relative pose that a pair has on its own is no judge: of a plane it has two solutions, of few matches none that is
sure. Its matches against the model are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from fieldstone.geometry.camera import image_from_cam
from fieldstone.mapping.disambiguation.options import AgreementOptions
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Reconstruction


@dataclass(frozen=True)
class PairAgreement:
    """How many of a pair's inliers could be tested against a model, and how many agree with it."""

    inliers: int
    tested: int
    agreeing: int

    def agrees(self, options: AgreementOptions) -> bool:
        """Whether the pair shows what the model shows."""
        return self.tested >= options.min_tested and self.agreeing >= options.agreeing * self.tested

    def contradicts(self, options: AgreementOptions) -> bool:
        """Whether the pair shows something else."""
        return self.tested >= options.min_tested and self.agreeing < options.contradicting * self.tested


def agreement_with_models(
    graph: MatchGraph, models: Sequence[Reconstruction], options: AgreementOptions
) -> dict[ImagePair, PairAgreement]:
    """The agreement of every verified pair whose photos lie in one model."""
    out: dict[ImagePair, PairAgreement] = {}
    verified = [pair for pair, two_view in sorted(graph.two_views.items()) if two_view.inliers.any()]
    for model in models:
        point_of = _point_of_keypoints(graph, model)
        for pair in verified:
            if pair[0] in point_of and pair[1] in point_of:
                out[pair] = _agreement(graph, model, pair, point_of, options)
    return out


def contradiction(agreements: Iterable[PairAgreement], options: AgreementOptions) -> float:
    """Share of all inliers that lie in pairs which contradict their model."""
    agreements = tuple(agreements)
    total = sum(a.inliers for a in agreements)
    return sum(a.inliers for a in agreements if a.contradicts(options)) / max(total, 1)


def _point_of_keypoints(graph: MatchGraph, model: Reconstruction) -> dict[int, Int[np.ndarray, "_"]]:
    """For every registered view, the point of each of its keypoints, -1 for none."""
    out = {v: np.full(len(graph.keypoints[v]), -1) for v in model.registered().tolist()}
    observations = model.observations
    for v, points in out.items():
        mine = observations.view == v
        points[observations.keypoint[mine]] = observations.point[mine]
    return out


def _agreement(
    graph: MatchGraph,
    model: Reconstruction,
    pair: ImagePair,
    point_of: Mapping[int, Int[np.ndarray, "_"]],
    options: AgreementOptions,
) -> PairAgreement:
    """Both directions of one pair: a match agrees if either of its keypoints has a point that appears at the other."""
    rows = graph.inlier_matches(pair)
    tested, agreeing = np.zeros(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    for one, other in ((0, 1), (1, 0)):
        point, view = point_of[pair[one]][rows[:, one]], pair[other]
        has_point = np.flatnonzero(point >= 0)
        in_cam = model.pose_of(view).apply(model.points.xyz[point[has_point]])
        pixels = image_from_cam(model.camera_of(view), in_cam)
        error = np.linalg.norm(pixels - graph.keypoints[view][rows[has_point, other]], axis=1)
        near = (in_cam[:, 2] > 0) & (error < options.max_error_px * graph.scale_of_image[view])  # nan is not near
        tested[has_point] = True
        agreeing[has_point[near]] = True
    return PairAgreement(len(rows), int(tested.sum()), int(agreeing.sum()))
