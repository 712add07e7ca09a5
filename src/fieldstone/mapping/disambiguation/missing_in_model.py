"""Missing correspondences of a finished model: points that a photo ought to show, and does not.

Where photos of different places that look alike lie upon each other in a model, what is alike is matched and what is
of one place is not. In a true model, photos that stand near each other and look the same way share what they show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.mapping.disambiguation.missing_correspondences import per_cell
from fieldstone.mapping.disambiguation.options import MissingOptions
from fieldstone.scene.match_graph import ImagePair
from fieldstone.scene.reconstruction import Reconstruction

MIN_COMMON = 10
"""Points in the common view, below which a pair of photos is not asked."""


@dataclass(frozen=True)
class MissingInModel:
    """Numbers of features in the common view of two photos, both directions and all grids together, over both."""

    missing: float
    """Without a match in regions where nothing matches, though both photos have points there."""
    expected: float
    """Matched, or unmatched anywhere in the common view."""

    def __add__(self, other: MissingInModel) -> MissingInModel:
        return MissingInModel(self.missing + other.missing, self.expected + other.expected)

    @property
    def rate(self) -> float:
        """The share that is missing."""
        return self.missing / max(self.expected, 1e-9)


NOTHING = MissingInModel(0.0, 0.0)


@dataclass(frozen=True, eq=False)
class _Shown:
    """The points that one photo shows."""

    point: Int[np.ndarray, "m"]
    pixels: Float[np.ndarray, "m 2"]
    direction: Float[np.ndarray, "m 3"]
    """From the camera to the point, of length 1."""
    distance: Float[np.ndarray, "m"]
    widest: Float[np.ndarray, "m"]
    """The largest angle from which another photo knows the point again, in radians."""


def find_missing_in_model(model: Reconstruction, options: MissingOptions) -> dict[ImagePair, MissingInModel]:
    """Missing correspondences of all pairs of photos that see something from nearly the same side and distance.

    A point counts where another photo, further away in angle, knows it again: what is recognised from afar ought to be
    recognised from near by.

    Source:
        `heinly2014`. Departure: regions are cells of a grid, and all near photos are asked, matched or not.
    """
    shown = _shown_points(model, options)
    has = {v: np.zeros(len(model.points), dtype=bool) for v in shown}
    for v, s in shown.items():
        has[v][s.point] = True
    out: dict[ImagePair, MissingInModel] = {}
    for i, j in _neighbors(model, options):
        counts = _without_matches(model, i, j, shown, has, options)
        pair = (min(i, j), max(i, j))
        out[pair] = out.get(pair, NOTHING) + counts
    return {pair: counts for pair, counts in sorted(out.items()) if counts.expected > 0}


def _without_matches(
    model: Reconstruction,
    i: int,
    j: int,
    shown: dict[int, _Shown],
    has: dict[int, Bool[np.ndarray, "p"]],
    options: MissingOptions,
) -> MissingInModel:
    """One direction: points of photo i in photo j, by the cells of photo j."""
    one, two, camera = shown[i], shown[j], model.camera_of(j)
    size = np.array([camera.width, camera.height])
    pose, xyz = model.pose_of(j), model.points.xyz[one.point]
    towards = xyz - pose.target_origin_in_source()
    distance = np.linalg.norm(towards, axis=1)
    angle = np.arccos(np.clip(np.sum(towards * one.direction, axis=1) / distance, -1.0, 1.0))
    scale, matched = distance / one.distance, has[j][one.point]
    near = (scale < options.max_scale) & (scale > 1.0 / options.max_scale)
    near &= (angle < np.deg2rad(options.max_angle_deg)) & (matched | (one.widest >= angle))
    if near.sum() < MIN_COMMON:
        return NOTHING
    inside, pixels = _in_image(camera, pose.apply(xyz), options.margin)
    near &= inside
    if near.sum() < MIN_COMMON:
        return NOTHING
    alone = ~has[i][two.point]
    alone[alone] = _in_image(model.camera_of(i), model.pose_of(i).apply(model.points.xyz[two.point[alone]]))[0]
    both = np.minimum(per_cell(pixels[near & ~matched], size, options), per_cell(two.pixels[alone], size, options))
    with_match = per_cell(pixels[near & matched], size, options)
    weight = 1.0 / (2 * len(options.grids))
    return MissingInModel(weight * float(both[with_match == 0].sum()), weight * float((both + with_match).sum()))


def _in_image(
    camera: Camera, points_in_cam: Float[np.ndarray, "m 3"], margin: float = 0.0
) -> tuple[Bool[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """In front of the camera and inside of the photo, this share of its longer side away from its edges; the pixels."""
    pixels, size = image_from_cam(camera, points_in_cam), np.array([camera.width, camera.height])
    edge = margin * size.max()
    inside = (points_in_cam[:, 2] > 0) & np.all((pixels > edge) & (pixels < size - edge), axis=1)  # nan is not inside
    return inside, pixels


def _shown_points(model: Reconstruction, options: MissingOptions) -> dict[int, _Shown]:
    """What every registered photo shows, thinned where photos show very many points."""
    observations, views = model.observations, model.registered().tolist()
    step = max(1, round(len(observations) / max(len(views), 1) / options.points_per_photo))
    rows = np.flatnonzero(observations.point % step == 0)
    view, point = observations.view[rows], observations.point[rows]
    centers = np.zeros((len(model.views), 3))
    centers[views] = model.camera_centers()
    towards = model.points.xyz[point] - centers[view]
    distance = np.linalg.norm(towards, axis=1)
    direction = towards / distance[:, None]
    widest = _widest_angles(point, direction, len(model.points))
    return {
        v: _Shown(point[mine], observations.pixels[rows[mine]], direction[mine], distance[mine], widest[mine])
        for v in views
        for mine in [np.flatnonzero(view == v)]
    }


def _widest_angles(
    point: Int[np.ndarray, "o"], direction: Float[np.ndarray, "o 3"], num_points: int
) -> Float[np.ndarray, "o"]:
    """For every observation, a bound on the largest angle to another ray of its point: by way of their mean."""
    mean = np.zeros((num_points, 3))
    np.add.at(mean, point, direction)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    off = np.arccos(np.clip(np.sum(mean[point] * direction, axis=1), -1.0, 1.0))
    largest = np.zeros(num_points)
    np.maximum.at(largest, point, off)
    return off + largest[point]


def _neighbors(model: Reconstruction, options: MissingOptions) -> list[tuple[int, int]]:
    """Ordered pairs of registered photos that stand nearest to each other."""
    views = model.registered()
    if len(views) < 2:
        return []
    centers = model.camera_centers()
    count = min(options.neighbors + 1, len(views))
    nearest = np.asarray(KDTree(centers).query(centers, k=count)[1])
    directed = {(int(views[a]), int(views[b])) for a, row in enumerate(nearest) for b in row if a != b}
    return sorted(directed | {(j, i) for i, j in directed})
