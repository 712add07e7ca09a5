"""Points of the compiled mappers: tracks triangulated by vote, a covering part of them for bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.solve.projection.undistortion import plane_from_images
from fieldstone.solve.robust.triangulation import triangulate_robust


def retriangulate(
    model: WorkingModel, tracks: Bool[np.ndarray, "t"], *, max_error_px: float, min_angle_deg: float
) -> WorkingModel:
    """The points of these tracks from nothing but the current poses; their observations are judged anew.

    Observations of registered views that do not agree with their point become inactive, the others active, whatever
    they were before. A track without two that agree, or without parallax, has no point.
    """
    rows = np.flatnonzero(model.registered[model.tracks.view] & tracks[model.tracks.point])
    uv = plane_coordinates(model, rows)
    valid = np.isfinite(uv[:, 0])  # nan outside the range of the lens model
    active = model.active.copy()
    active[rows[~valid]] = False
    rows, uv = rows[valid], uv[valid]
    point = model.tracks.point[rows]
    ids, starts = np.unique(point, return_index=True)
    found, inliers = triangulate_robust(
        model.cam_from_world,
        model.scaled_focals(),
        model.tracks.view[rows],
        uv,
        np.append(starts, len(rows)),
        max_error_px=max_error_px,
        min_angle=float(np.deg2rad(min_angle_deg)),
    )
    xyz = model.xyz.copy()
    xyz[tracks] = np.nan
    xyz[ids] = found
    active[rows] = inliers
    return replace(model, xyz=xyz, active=active)


def tracks_of_view(model: WorkingModel, view: int) -> Bool[np.ndarray, "t"]:
    """The tracks that a view takes part in."""
    out = np.zeros(len(model.xyz), dtype=bool)
    out[model.tracks.point[model.tracks.view == view]] = True
    return out


def covering_tracks(
    model: WorkingModel, per_view: int, among: Bool[np.ndarray, "t"] | None = None
) -> Bool[np.ndarray, "t"]:
    """Points that carry a bundle adjustment: the longest tracks, until every view sees `per_view` of them.

    With `among`, only these tracks are considered.

    Every point counts for all its views, so views that share points fill up together. Among tracks of one length the
    order is that of their numbers, which is unrelated to where they lie.

    Source:
        The idea of `cui2017tracks`: a well-chosen part of the tracks gives the same poses.
    """
    rows = model.used_observations()
    if among is not None:
        rows = rows[among[model.tracks.point[rows]]]
    point, view = model.tracks.point[rows], model.tracks.view[rows]
    length = np.bincount(point, minlength=len(model.xyz))
    # Rank the observations of each view by the length of their track: the first `per_view` of a view are needed.
    order = np.lexsort((point, -length[point], view))
    sorted_view = view[order]
    first = np.concatenate([[0], np.flatnonzero(np.diff(sorted_view)) + 1]) if len(order) else np.empty(0, np.int64)
    counts = np.diff(np.append(first, len(order)))
    rank = np.arange(len(order)) - np.repeat(first, counts)
    out = np.zeros(len(model.xyz), dtype=bool)
    out[point[order[rank < per_view]]] = True
    return out


def plane_coordinates(model: WorkingModel, rows: Int[np.ndarray, "u"]) -> Float[np.ndarray, "u 2"]:
    """Ideal coordinates on the plane z = 1 of observations; nan outside the range of the lens model."""
    camera = model.camera_of_view[model.tracks.view[rows]]
    return plane_from_images(model.cameras, camera, model.tracks.pixels[rows])
