"""The global mapper: all rotations at once, then all positions, where focal lengths are known well enough."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.incremental.checkpoint import CheckpointStore
from fieldstone.mapping.incremental.mapper import extend
from fieldstone.mapping.incremental.options import RETRY_STAGES, IncrementalOptions
from fieldstone.mapping.incremental.state import RegistrationState, RegistrationTask, SubModel, largest_first
from fieldstone.mapping.model.calibration import CalibrationStep
from fieldstone.mapping.model.refinement import adjust_globally
from fieldstone.mapping.model.triangulation import covering_tracks, plane_coordinates, retriangulate
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.tracks import build_tracks
from fieldstone.solve.averaging.positions import position_views_and_points
from fieldstone.solve.averaging.rotations import average_rotations, residual_rotations

logger = logging.getLogger(__name__)

MIN_INLIERS = 30
"""Pairs with fewer take no part."""
MAX_ROTATION_ERROR_DEG = 10.0
"""Pairs that are further off the averaged rotations are taken for false."""
TRACKS_PER_VIEW = 100
"""Tracks that place the cameras: enough of them tell the whole."""
MIN_TRACK_LENGTH = 3
"""Two rays fix a point but say nothing of the scale between cameras."""
TOLERANCES = (8.0, 3.0, 1.0)
"""Factors of the largest reprojection error, from the first triangulation to the last."""


@dataclass(frozen=True, eq=False)
class _Edges:
    """Pairs with a relative pose."""

    pairs: Int[np.ndarray, "e 2"]
    Rj_from_Ri: Float[np.ndarray, "e 3 3"]
    weights: Float[np.ndarray, "e"]

    def where(self, keep: Bool[np.ndarray, "e"]) -> _Edges:
        """The edges of a mask."""
        return _Edges(self.pairs[keep], self.Rj_from_Ri[keep], self.weights[keep])


def map_global(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    calibration: Sequence[CalibrationStep | None],
    options: IncrementalOptions,
    seed: int,
    store: CheckpointStore | None = None,
    on_progress: OnProgress = silent,
) -> list[SubModel]:
    """Every component of the graph, the one with most photos first; arguments as `map_incremental`.

    Rotations are averaged over the pairs, pairs that contradict them are dropped, and a linear problem gives the
    positions from the longest tracks. Bundle adjustment follows while false observations are taken out, and photos
    that are left over are registered one by one.

    Source:
        The order of `pan2024`.
    """
    progress = StageProgress(on_progress, "registering photos", graph.num_images)
    available = np.ones(graph.num_images, dtype=bool)
    sub_models: list[SubModel] = []
    edges = _edges(graph)
    while len(edges.pairs):
        component = _largest_component(edges.pairs, graph.num_images)
        inside = component[edges.pairs[:, 0]]
        placed = _place(graph, edges.where(inside), cameras, camera_of_image, options)
        if placed is None:
            edges = edges.where(~inside)
            continue
        model, pair = placed
        held = int(np.sum(~available))
        progress.at(held + model.num_registered)
        task = RegistrationTask(
            graph, available, tuple(calibration), options, seed, lambda count, held=held: progress.at(held + count)
        )
        reasons = dict.fromkeys(np.flatnonzero(model.registered).tolist(), "placed with all others at once")
        sub_models.append(extend(RegistrationState.start(model, reasons), pair, task, store))
        available = available & ~sub_models[-1].model.registered
        logger.info("sub-model of %d photos", sub_models[-1].num_registered)
        edges = edges.where(np.all(available[edges.pairs], axis=1))
    return largest_first(sub_models)


def _edges(graph: MatchGraph) -> _Edges:
    """Verified pairs whose relative pose is known."""
    found = {
        pair: two_view
        for pair, two_view in sorted(graph.two_views.items())
        if two_view.kind in ("calibrated", "planar", "panoramic") and two_view.inliers.sum() >= MIN_INLIERS
    }
    known = {pair: (tv.cam2_from_cam1.R, float(tv.inliers.sum())) for pair, tv in found.items() if tv.cam2_from_cam1}
    return _Edges(
        np.array(list(known), dtype=np.int64).reshape(-1, 2),
        np.array([R for R, _ in known.values()]).reshape(-1, 3, 3),
        np.array([weight for _, weight in known.values()]),
    )


def _largest_component(pairs: Int[np.ndarray, "e 2"], num_images: int) -> Bool[np.ndarray, "n"]:
    """Photos of the component with most of them."""
    adjacency = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num_images, num_images))
    label = connected_components(adjacency, directed=False)[1]
    return label == np.argmax(np.bincount(label))


def _place(
    graph: MatchGraph,
    edges: _Edges,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: IncrementalOptions,
) -> tuple[WorkingModel, ImagePair] | None:
    """Poses and points of one component, and its strongest pair; None if too little holds it together."""
    averaged = _rotations(edges, graph.num_images)
    if averaged is None:
        return None
    edges, rotations = averaged
    consistent = {(int(i), int(j)) for i, j in edges.pairs}
    trusted = replace(
        graph,
        matches={pair: rows for pair, rows in graph.matches.items() if pair in consistent},
        two_views={pair: found for pair, found in graph.two_views.items() if pair in consistent},
    )
    poses = _positions(trusted, rotations, cameras, camera_of_image)
    if poses is None:
        return None
    # All matches make the points: those of a dropped pair may be right, and are judged one by one.
    tracks, _ = build_tracks(graph, split_conflicts=True)
    views, cam_from_world = poses
    model = WorkingModel.start(tuple(cameras), camera_of_image, tracks, graph.pixel_scale).with_poses(
        views, cam_from_world
    )
    strict = RETRY_STAGES[0]
    for tolerance in TOLERANCES:
        error = tolerance * options.max_error_px
        model = retriangulate(model, model.all_tracks(), max_error_px=error, min_angle_deg=strict.min_angle_deg)
        model = _without_lonely_views(model, strict.min_inliers)
        if model.num_registered < 2:
            return None
        model = adjust_globally(model, options.refinement, (None,) * len(cameras))
    model = retriangulate(
        model, model.all_tracks(), max_error_px=options.max_error_px, min_angle_deg=strict.min_angle_deg
    )
    model = _without_lonely_views(model, strict.min_inliers)
    inside = model.registered[edges.pairs].all(axis=1)
    if not inside.any():
        return None
    i, j = edges.pairs[inside][np.argmax(edges.weights[inside])].tolist()
    return model, (i, j)


def _rotations(edges: _Edges, num_images: int) -> tuple[_Edges, dict[int, Float[np.ndarray, "3 3"]]] | None:
    """Consistent pairs of the largest component and the rotation of each of its photos, averaged twice."""
    rotations: dict[int, Float[np.ndarray, "3 3"]] = {}
    for _ in range(2):
        if not len(edges.pairs):
            return None
        views = np.flatnonzero(_largest_component(edges.pairs, num_images))
        edges = edges.where(np.isin(edges.pairs[:, 0], views))
        pairs = np.searchsorted(views, edges.pairs)
        R = average_rotations(pairs, edges.Rj_from_Ri, edges.weights)
        rotations = dict(zip(views.tolist(), R, strict=True))
        angle = np.linalg.norm(residual_rotations(pairs, edges.Rj_from_Ri, R), axis=1)
        edges = edges.where(angle < np.deg2rad(MAX_ROTATION_ERROR_DEG))
    return edges, rotations


def _positions(
    graph: MatchGraph,
    rotations: dict[int, Float[np.ndarray, "3 3"]],
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
) -> tuple[Int[np.ndarray, "k"], Rigid3] | None:
    """The photos that the covering tracks hold and their poses; None if there are no such tracks."""
    tracks, _ = build_tracks(graph, split_conflicts=True)
    model = WorkingModel.start(tuple(cameras), camera_of_image, tracks, graph.pixel_scale)
    R = np.array(list(rotations.values()))
    model = model.with_poses(np.array(list(rotations)), Rigid3(R, np.zeros((len(R), 3))))
    long = np.bincount(tracks.point, minlength=len(model.xyz)) >= MIN_TRACK_LENGTH
    model = replace(model, xyz=np.where(long[:, None], 0.0, np.full((len(long), 3), np.nan)))
    rows = model.used_observations()
    rows = rows[covering_tracks(model, TRACKS_PER_VIEW)[tracks.point[rows]]]
    uv = plane_coordinates(model, rows)
    rows, uv = rows[np.isfinite(uv[:, 0])], uv[np.isfinite(uv[:, 0])]
    rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if not len(rows):
        return None
    R = model.cam_from_world.R
    views, view = np.unique(tracks.view[rows], return_inverse=True)
    _, point = np.unique(tracks.point[rows], return_inverse=True)
    in_world = np.einsum("kji,kj->ki", R[tracks.view[rows]], rays)
    if len(views) < 2:
        return None
    centers, _ = position_views_and_points(view, point, in_world)
    t = np.array([-R[v] @ center for v, center in zip(views, centers, strict=True)])
    return views, Rigid3(R[views], t)


def _without_lonely_views(model: WorkingModel, min_points: int) -> WorkingModel:
    """Views that see fewer points lose their pose."""
    seen = np.bincount(model.tracks.view[model.used_observations()], minlength=model.num_views)
    return model.only_registered(seen >= min_points)
