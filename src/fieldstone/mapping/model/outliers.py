"""Points of a working model: triangulate new ones, drop observations that do not fit, recall those that fit again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.triangulation import triangulate_tracks_linear
from fieldstone.mapping.model.triangulation import plane_coordinates
from fieldstone.mapping.model.working_model import WorkingModel, record_views, reprojections
from fieldstone.scene.mapping_run import Drop, StageRecord
from fieldstone.solve.robust.loss import soft_l1
from fieldstone.solve.robust.nonlinear import triangulate_nonlinear


def triangulate_new_points(
    model: WorkingModel, names: Sequence[str], record: Sequence[int], robust_scale_px: float
) -> tuple[WorkingModel, list[StageRecord]]:
    """Linear, then non-linear triangulation of every track without a point that two registered views see.

    Args:
        record: Views whose reprojections of the new points are recorded after each of the two stages.
    """
    rows = np.flatnonzero(model.active & model.registered[model.tracks.view] & ~model.is_point()[model.tracks.point])
    is_new = np.bincount(model.tracks.point[rows], minlength=len(model.xyz)) >= 2
    rows = rows[is_new[model.tracks.point[rows]]]
    track_ids, point = np.unique(model.tracks.point[rows], return_inverse=True)
    view, pixels = model.tracks.view[rows], model.tracks.pixels[rows]
    poses = model.cam_from_world

    linear = triangulate_tracks_linear(poses, view, point, plane_coordinates(model, rows), len(track_ids))
    linear[~np.all(np.isfinite(linear), axis=1)] = np.nan
    model = _with_points(model, track_ids, linear)
    records = record_views(model, names, "linear triangulation", record, is_new)
    refined = triangulate_nonlinear(
        model.cameras, model.camera_of_view, poses, view, point, pixels, linear, loss=soft_l1(robust_scale_px)
    )
    model = _with_points(model, track_ids, refined)
    return model, records + record_views(model, names, "non-linear triangulation", record, is_new)


def drop_outliers(
    model: WorkingModel, stage: str, max_error_px: float, min_angle_deg: float
) -> tuple[WorkingModel, list[Drop]]:
    """Drop observations behind the camera or too far off, then points without two views or without parallax.

    A dropped observation stays in its track and may be recalled. A point without parallax loses its position, its
    observations stay: a later view may give the angle.
    """
    result = reprojections(model)
    behind = np.isinf(result.errors)
    far_off = ~behind & (result.scaled_errors > max_error_px)
    active = model.active.copy()
    active[result.rows[behind | far_off]] = False
    model = replace(model, active=active)
    limit_px = max_error_px * model.typical_pixel_scale()
    drops = [
        Drop(stage, "behind the camera", int(behind.sum())),
        Drop(stage, f"reprojection error over {limit_px:g} px", int(far_off.sum())),
    ]

    rows = model.used_observations()
    lengths = np.bincount(model.tracks.point[rows], minlength=len(model.xyz))
    is_point = model.is_point()
    lonely = is_point & (lengths < 2)
    narrow = is_point & ~lonely & (_largest_angles(model) < np.deg2rad(min_angle_deg))
    drops += [
        Drop(stage, "no second view left", int(lengths[lonely].sum())),
        Drop(stage, f"rays meet at less than {min_angle_deg:g} deg", int(lengths[narrow].sum())),
    ]
    xyz = model.xyz.copy()
    xyz[lonely | narrow] = np.nan
    return replace(model, xyz=xyz), [drop for drop in drops if drop.observations]


def recall_observations(model: WorkingModel, max_error_px: float) -> WorkingModel:
    """Take dropped observations of points back whose reprojection error is small now."""
    candidates = np.flatnonzero(
        ~model.active & model.registered[model.tracks.view] & model.is_point()[model.tracks.point]
    )
    result = reprojections(model, candidates)
    active = model.active.copy()
    active[candidates[result.scaled_errors <= max_error_px]] = True
    return replace(model, active=active)


def _with_points(model: WorkingModel, track_ids: np.ndarray, xyz: Float[np.ndarray, "p 3"]) -> WorkingModel:
    """The model with these positions."""
    out = model.xyz.copy()
    out[track_ids] = xyz
    return replace(model, xyz=out)


def _largest_angles(model: WorkingModel) -> Float[np.ndarray, "t"]:
    """Largest angle between two rays of each point's used observations, in radians; 0 without two.

    Exact for all pairs of a track; tracks are short in the sets that this mapper is for.
    """
    rows = model.used_observations()
    centers = model.cam_from_world.target_origin_in_source()
    point = model.tracks.point[rows]
    rays = model.xyz[point] - centers[model.tracks.view[rows]]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    largest = np.zeros(len(model.xyz))
    longest = int(np.bincount(point).max()) if len(point) else 0
    for gap in range(1, longest):  # observation k against observation k + gap of the same point
        same: Bool[np.ndarray, "m"] = point[gap:] == point[:-gap]
        a, b = rays[gap:][same], rays[:-gap][same]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
        np.maximum.at(largest, point[gap:][same], angle)
    return largest
