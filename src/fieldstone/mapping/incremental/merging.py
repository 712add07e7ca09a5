"""Sub-models that hang together by few matches become one: too few for a photo of the one to be placed in the other."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.epipolar import homogeneous
from fieldstone.geometry.sim3 import Sim3
from fieldstone.mapping.incremental.mapper import continue_with_graph
from fieldstone.mapping.incremental.options import RETRY_STAGES, IncrementalOptions
from fieldstone.mapping.incremental.registration import epipolar_errors, register_view
from fieldstone.mapping.incremental.state import SubModel, largest_first
from fieldstone.mapping.model.refinement import adjust_globally
from fieldstone.mapping.model.triangulation import plane_coordinates, retriangulate
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.solve.robust.frame_similarity import COARSE_FACTOR, Sightings, errors_px, estimate_frame_similarity
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view

logger = logging.getLogger(__name__)

MAX_LINKS = 8
"""Pairs of photos between two sub-models whose rotations are tried."""
MAX_PHOTOS = 3
"""Photos of either sub-model that get a pose from the points of the other, for its rotation."""
MIN_POSE_POINTS = 6
"""Points that make a pose worth looking at; what it says is judged with everything else."""
MIN_PHOTOS = 3
"""Of either sub-model: what two photos say of each other, a third has to confirm."""
MIN_SIGHTINGS = 8
"""Photos of either model that see points of the other where they should."""
MIN_SIGHTINGS_SHARE = 0.6
"""Of all sightings, as many must agree: photos of look-alikes see points of each other too, all over the place."""
RIVAL_SHARE = 0.25
"""Sightings that agree with another place, over those that agree with the best, from which on neither is believed."""
MIN_SHARED_POINTS = 20
"""Points that photos of both see."""
MIN_KEPT_POINTS = 0.9
"""Of the points of the two sub-models, as many must be left when they have become one."""
MIN_AGREEMENT = 0.5
"""Matches of links that agree with the merged model, over those that agree with their pair alone."""
MAX_LINK_ERROR_PX = 3.0
"""Matches of links whose Sampson error is smaller agree with the merged model."""


@dataclass(frozen=True, eq=False)
class Link:
    """A pair of photos, one of each of two models, that match.

    a_R_b: the rotation between the frames of the models that the pair asks for.
    inliers: matches that agree with the pair's own geometry.
    """

    pair: ImagePair
    a_R_b: Float[np.ndarray, "3 3"]
    inliers: int


def merge_linked(
    sub_models: Sequence[SubModel], graph: MatchGraph, options: IncrementalOptions, seed: int
) -> list[SubModel]:
    """The sub-models, those made one whose photos match and see each other's points; the largest first.

    Photos that no sub-model holds are tried again with a merged one.

    Args:
        graph: Verified; the one that the sub-models were registered with.
    """
    left = list(sub_models)
    while (merged := _merge_first(left, graph, options, seed)) is not None:
        left = merged
    if len(left) < len(sub_models):
        elsewhere = sum((s.model.registered for s in left[1:]), start=np.zeros(graph.num_images, dtype=bool))
        left[0] = continue_with_graph(left[0], graph, ~elsewhere, options, seed) or left[0]
    return left


def _merge_first(
    sub_models: list[SubModel], graph: MatchGraph, options: IncrementalOptions, seed: int
) -> list[SubModel] | None:
    """The sub-models after the first merger that succeeds; None if there is none."""
    for a, b in combinations(range(len(sub_models)), 2):
        first_photos = [int(np.argmax(sub_models[k].model.registered)) for k in (a, b)]
        merged = merge(sub_models[a], sub_models[b], graph, options, np.random.default_rng([seed, *first_photos]))
        if merged is not None:
            return largest_first([merged, *(s for k, s in enumerate(sub_models) if k not in (a, b))])
    return None


def merge(
    a: SubModel, b: SubModel, graph: MatchGraph, options: IncrementalOptions, rng: np.random.Generator
) -> SubModel | None:
    """Two sub-models on the same tracks in one; None if they do not fit together.

    They fit if photos of the one see points of the other where they should, and in no other place; if hardly a point
    is lost and many are there that photos of both see; and if matches between them agree with the result.
    """
    if min(a.num_registered, b.num_registered) < MIN_PHOTOS:
        return None
    sightings = sightings_of_each_other(a.model, b.model)
    links = links_between(a.model, b.model, graph, rng) if len(sightings) >= MIN_SIGHTINGS else []
    if not links:
        return None
    rotations = [link.a_R_b for link in links[:MAX_LINKS]] + _rotations_by_points(a.model, b.model, options, rng)
    limit = options.pnp.max_error_px
    found = estimate_frame_similarity(sightings, np.array(rotations), limit, rng)
    if found is None or found.inliers.sum() < max(MIN_SIGHTINGS, MIN_SIGHTINGS_SHARE * len(sightings)):
        return None
    # Where places look alike, what disagrees is of one mind too.
    rest = sightings.select(errors_px(found.a_from_b, sightings) >= COARSE_FACTOR * limit)
    rival = estimate_frame_similarity(rest, np.array(rotations), limit, rng)
    if rival is not None and rival.inliers.sum() >= max(MIN_SIGHTINGS, RIVAL_SHARE * found.inliers.sum()):
        logger.info(
            "sub-models of %d and %d photos: %d of %d sightings agree with one place, %d with another",
            a.num_registered, b.num_registered, found.inliers.sum(), len(sightings), rival.inliers.sum(),
        )  # fmt: skip
        return None
    model = _with_points(united(a.model, b.model, found.a_from_b), options)
    for _ in range(2):
        model = _with_points(adjust_globally(model, options.refinement, a.calibration), options)
    against = _against(model, a.model, b.model, links, graph)
    logger.info(
        "sub-models of %d and %d photos: %d of %d sightings agree, %s",
        a.num_registered, b.num_registered, found.inliers.sum(), len(sightings), against or "merged",
    )  # fmt: skip
    if against:
        return None
    return SubModel(model, a.initial_pair, {**b.reasons, **a.reasons}, {**b.failures, **a.failures}, a.calibration)


def sightings_of_each_other(a: WorkingModel, b: WorkingModel) -> Sightings:
    """Photos of either model that see points of the other; models on the same tracks."""
    centers_a, rays_a, focals_a, points_b = _sightings(a, b)
    centers_b, rays_b, focals_b, points_a = _sightings(b, a)
    return Sightings(
        from_a=np.repeat([True, False], [len(centers_a), len(centers_b)]),
        in_a=np.concatenate([centers_a, points_a]),
        in_b=np.concatenate([points_b, centers_b]),
        rays=np.concatenate([rays_a, rays_b]),
        focals=np.concatenate([focals_a, focals_b]),
    )


def _sightings(
    photos: WorkingModel, points: WorkingModel
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Centres, unit rays and focal lengths where registered photos of one model see points of the other; the points."""
    view, point = photos.tracks.view, photos.tracks.point
    rows = np.flatnonzero(photos.registered[view] & ~points.registered[view] & points.is_point()[point])
    uv = plane_coordinates(photos, rows)
    rows, uv = rows[np.isfinite(uv[:, 0])], uv[np.isfinite(uv[:, 0])]
    view = view[rows]
    rays = np.einsum("nji,nj->ni", photos.cam_from_world.R[view], homogeneous(uv))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    centers = photos.cam_from_world.target_origin_in_source()
    return centers[view], rays, photos.scaled_focals()[view], points.xyz[point[rows]]


def links_between(a: WorkingModel, b: WorkingModel, graph: MatchGraph, rng: np.random.Generator) -> list[Link]:
    """Pairs of a photo of each model whose matches have a geometry with the cameras of the models, best first."""
    links = []
    for i, j in sorted(graph.two_views):
        of_i, of_j = (a, b) if a.registered[i] else (b, a)
        if not (of_i.registered[i] and of_j.registered[j] and graph.two_views[i, j].inliers.any()):
            continue
        cameras, scales = (of_i.camera_of(i), of_j.camera_of(j)), graph.scale_of_image[[i, j]].tolist()
        pixels = graph.matched_pixels((i, j))
        found = estimate_two_view(*cameras, *pixels, TwoViewOptions(), rng, pixel_scales=(scales[0], scales[1]))
        if found.cam2_from_cam1 is None or found.kind == "panoramic":
            continue
        R = of_i.pose_of(i).R.T @ found.cam2_from_cam1.R.T @ of_j.pose_of(j).R
        links.append(Link((i, j), R if of_i is a else R.T, int(found.inliers.sum())))
    return sorted(links, key=lambda link: (-link.inliers, link.pair))


def _rotations_by_points(
    a: WorkingModel, b: WorkingModel, options: IncrementalOptions, rng: np.random.Generator
) -> list[Float[np.ndarray, "3 3"]]:
    """Rotations from b to a by photos of either that see enough points of the other for a pose there."""
    rotations = []
    for photos, points in ((a, b), (b, a)):
        seen = points.visible_points_per_view() * (photos.registered & ~points.registered)
        most = np.argsort(-seen, kind="stable")[:MAX_PHOTOS]
        for v in most[seen[most] >= MIN_POSE_POINTS].tolist():
            pose = register_view(points, v, options.pnp, MIN_POSE_POINTS, rng).cam_from_world
            if pose is not None:
                points_R_photos = pose.R.T @ photos.pose_of(v).R
                rotations.append(points_R_photos if points is a else points_R_photos.T)
    return rotations


def united(a: WorkingModel, b: WorkingModel, a_from_b: Sim3) -> WorkingModel:
    """The poses of both in the frame of a, with the points of a; cameras are those of a where it has photos of them."""
    views = np.flatnonzero(b.registered)
    in_a = np.isin(np.arange(len(a.cameras)), a.camera_of_view[a.registered])
    cameras = tuple(ca if mine else cb for ca, cb, mine in zip(a.cameras, b.cameras, in_a, strict=True))
    return replace(a, cameras=cameras).with_poses(views, a_from_b.move_pose(b.cam_from_world[views]))


def _against(model: WorkingModel, a: WorkingModel, b: WorkingModel, links: Sequence[Link], graph: MatchGraph) -> str:
    """Why the photos of two models are not one model, or an empty text."""
    shared = int(np.sum(_seen_by(model, a.registered) & _seen_by(model, b.registered)))
    if shared < MIN_SHARED_POINTS:
        return f"but they share only {shared} points"
    before, after = int(a.is_point().sum() + b.is_point().sum()), int(model.is_point().sum())
    if after < MIN_KEPT_POINTS * before:
        return f"but {after} of {before} points are left"
    agree, total = sum(_agreeing(link.pair, model, graph) for link in links), sum(link.inliers for link in links)
    if agree < MIN_AGREEMENT * total:
        return f"but of {total} matches between them {agree} agree with the whole"
    return ""


def _seen_by(model: WorkingModel, views: Bool[np.ndarray, "v"]) -> Bool[np.ndarray, "t"]:
    """Points that one of these views sees."""
    rows = model.used_observations()
    seen = np.zeros(len(model.xyz), dtype=bool)
    seen[model.tracks.point[rows[views[model.tracks.view[rows]]]]] = True
    return seen


def _agreeing(pair: ImagePair, model: WorkingModel, graph: MatchGraph) -> int:
    """Matches of a pair that agree with its poses in a model."""
    i, j = pair
    errors = epipolar_errors(model, graph, pair, model.pose_of(j) @ model.pose_of(i).inverse())
    return int(np.sum(errors < MAX_LINK_ERROR_PX))


def _with_points(model: WorkingModel, options: IncrementalOptions) -> WorkingModel:
    """Every track triangulated from the poses of the model."""
    limits = {"max_error_px": options.max_error_px, "min_angle_deg": RETRY_STAGES[0].min_angle_deg}
    return retriangulate(model, model.all_tracks(), **limits)
