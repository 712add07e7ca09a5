"""The pose of one more photo from the points that it sees, and whether its pairs contradict that pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.camera import plane_from_image
from fieldstone.geometry.epipolar import essential_from_pose, homogeneous, sampson_error
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.solve.robust.absolute_pose import estimate_absolute_pose
from fieldstone.solve.robust.ransac import RansacOptions

MAX_ROTATION_DIFFERENCE = float(np.deg2rad(15.0))
"""Pairs whose rotation differs by less agree with a pose."""
MAX_EPIPOLAR_ERROR_PX = 4.0
"""Matches whose Sampson error is smaller agree with a pose, times the pixel scale."""
MAX_DOUBT = 0.2
"""Larger shares of matches that contradict a model tell of wrong cameras: false pairs were taken out before."""


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
    options = replace(options, max_error_px=options.max_error_px * float(model.pixel_scale[view]))
    found = estimate_absolute_pose(
        model.camera_of(view), model.tracks.pixels[rows], model.xyz[model.tracks.point[rows]], options, rng
    )
    if found is None or found.inliers.sum() < min_inliers:
        return Registration(None, 0 if found is None else int(found.inliers.sum()), len(rows))
    return Registration(found.cam_from_world, int(found.inliers.sum()), len(rows))


def contradicts_pairs(model: WorkingModel, graph: MatchGraph, view: int, cam_from_world: Rigid3) -> str:
    """Why a pose of a photo cannot be, or an empty text.

    Most matches with registered photos ask for another pose, or there are none: where a scene repeats itself, a
    few false matches turn the points of one place into those of another. Where many matches among the registered
    photos do so, pairs say nothing: their rotations come from cameras that the model has since refined.
    """
    partners = _registered_partners(model, graph, view)
    if not partners:
        return "none of its photos has matches with this one"
    agree, differ = _agreement(model, graph, view, cam_from_world, partners)
    if differ <= agree:
        return ""
    registered = np.flatnonzero(model.registered).tolist()
    of_others = [
        _agreement(model, graph, v, model.pose_of(v), _registered_partners(model, graph, v)) for v in registered
    ]
    all_agree, all_differ = np.sum(of_others, axis=0)
    if all_differ > MAX_DOUBT * (all_agree + all_differ):
        return ""
    return f"{differ} of {agree + differ} matches with its photos ask for another pose"


def _registered_partners(model: WorkingModel, graph: MatchGraph, view: int) -> list[int]:
    """Registered photos that a photo has verified matches with."""
    partners = [j if view == i else i for i, j in graph.two_views if view in (i, j)]
    return [p for p in partners if model.registered[p] and _two_view(graph, view, p).inliers.any()]


def _two_view(graph: MatchGraph, a: int, b: int) -> TwoView:
    return graph.two_views[min(a, b), max(a, b)]


def _agreement(
    model: WorkingModel, graph: MatchGraph, view: int, cam_from_world: Rigid3, partners: Sequence[int]
) -> tuple[int, int]:
    """Matches of pairs that agree with a photo's pose, or tell nothing of it; and of those that do not.

    Where the rotation of a pair differs, its matches have the last word: of a plane, or with a focal length that has
    been refined since, the pair's own pose is no judge.
    """
    agree, differ = 0, 0
    for partner in partners:
        two_view = _two_view(graph, view, partner)
        pose, inliers = two_view.cam2_from_cam1, int(two_view.inliers.sum())
        R = None if pose is None else (pose.R if view > partner else pose.R.T) @ model.pose_of(partner).R
        if R is None or angle_between(R, cam_from_world.R) < MAX_ROTATION_DIFFERENCE:
            agree += inliers
        else:
            on_lines = _matches_on_epipolar_lines(model, graph, view, cam_from_world, partner)
            agree, differ = agree + on_lines, differ + inliers - on_lines
    return agree, differ


def epipolar_errors(
    model: WorkingModel,
    graph: MatchGraph,
    pair: ImagePair,
    cam2_from_cam1: Rigid3,
    matches: Int[np.ndarray, "m 2"] | None = None,
) -> Float[np.ndarray, "m"]:
    """Sampson errors of a pair's matches (by default all putative ones), in pixels over the pixel scale."""
    pixels = graph.matched_pixels(pair, matches)
    rays = [homogeneous(plane_from_image(model.camera_of(v), p)) for v, p in zip(pair, pixels, strict=True)]
    focal = float(np.sqrt(np.prod(model.scaled_focals()[list(pair)])))
    return focal * np.sqrt(sampson_error(essential_from_pose(cam2_from_cam1), *rays))


def _matches_on_epipolar_lines(
    model: WorkingModel, graph: MatchGraph, view: int, cam_from_world: Rigid3, partner: int
) -> int:
    """How many inliers of a photo with a registered one agree with its pose."""
    pair, poses = (min(view, partner), max(view, partner)), {view: cam_from_world, partner: model.pose_of(partner)}
    cam2_from_cam1 = poses[pair[1]] @ poses[pair[0]].inverse()
    errors = epipolar_errors(model, graph, pair, cam2_from_cam1, graph.inlier_matches(pair))
    return int(np.sum(errors < MAX_EPIPOLAR_ERROR_PX))  # nan is not small


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
