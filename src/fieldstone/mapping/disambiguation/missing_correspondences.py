"""Missing correspondences: features that a pair of photos ought to share under its geometry, and does not.

Where two photos show different places that look alike, what is alike matches and what is of one place does not. So
there are regions where both photos have features that other pairs confirm, the geometry says that both see the region,
and not one feature there matches. Where both photos show the same place, every such region has matches.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, bearings_from_image, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.disambiguation.options import MissingOptions
from fieldstone.scene.match_graph import ImagePair, MatchGraph


@dataclass(frozen=True)
class MissingCorrespondences:
    """How much of a pair's common view goes without matches; numbers of features, both directions together."""

    missing: int
    """Unmatched in regions without any match; of the two photos' counts the smaller."""
    expected: int
    """Matched, or unmatched anywhere in the common view."""
    inliers: int
    angle: float
    """Median angle between the rays of the inliers, in radians."""


@dataclass(frozen=True, eq=False)
class _Neighbor:
    """A photo that shares points with the photo in the middle."""

    view: int
    from_center: Rigid3
    """Baseline of length 1, or 0 for a camera that only turned."""
    own: Int[np.ndarray, "m"]
    """Keypoints of the photo in the middle, of which `other` are the matches."""
    other: Int[np.ndarray, "m"]
    depth: Float[np.ndarray, "m"]
    angle: Float[np.ndarray, "m"]


def find_missing_correspondences(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: MissingOptions,
    wanted: Collection[ImagePair] | None = None,
) -> dict[ImagePair, MissingCorrespondences]:
    """Missing correspondences of every pair that has a relative pose, or of those that are wanted.

    The neighbours of each photo are brought to one scale by the depths that they share, which tells where any of the
    photo's points would appear in each neighbour.

    Source:
        `heinly2014`: features of both photos that no match connects, in regions that overlap under the geometry.
        Departure: a star of neighbours takes the place of a finished model, regions are cells of a grid.
    """
    n = graph.num_images
    own_cameras = [cameras[c] for c in camera_of_image]
    bearings = [bearings_from_image(own_cameras[k], graph.keypoints[k]) for k in range(n)]
    stars = _stars(graph, bearings)
    confirmed = [np.zeros(len(k), dtype=bool) for k in graph.keypoints]
    for center, star in enumerate(stars):
        for neighbor in star:
            confirmed[center][neighbor.own] = True
    sums: dict[ImagePair, tuple[int, int]] = {}
    angles: dict[ImagePair, float] = {}
    for center, star in enumerate(stars):
        scales, depths = _one_scale(star, len(graph.keypoints[center]), options)
        known = np.flatnonzero(np.isfinite(depths))
        points = bearings[center][known] * depths[known, None]
        for neighbor, scale in zip(star, scales, strict=True):
            view, pair = neighbor.view, (min(center, neighbor.view), max(center, neighbor.view))
            if wanted is not None and pair not in wanted:
                continue
            angles[pair] = float(np.median(neighbor.angle))
            before = sums.setdefault(pair, (0, 0))
            if not np.isfinite(scale):
                if angles[pair] > np.deg2rad(options.min_parallax_deg):
                    continue
                scale = 0.0  # so short a baseline moves nothing
            T = Rigid3(neighbor.from_center.R, scale * neighbor.from_center.t)
            in_neighbor = T.apply(points[~np.isin(known, neighbor.own)])
            missing, expected = _without_matches(
                own_cameras[view], in_neighbor, graph.keypoints[view], neighbor.other, confirmed[view], options
            )
            sums[pair] = before[0] + missing, before[1] + expected
    inliers = {pair: int(graph.two_views[pair].inliers.sum()) for pair in sums}
    return {pair: MissingCorrespondences(*sums[pair], inliers[pair], angles[pair]) for pair in sorted(sums)}


def _without_matches(
    camera: Camera,
    unmatched_in_cam: Float[np.ndarray, "u 3"],
    keypoints: Float[np.ndarray, "k 2"],
    matched: Int[np.ndarray, "m"],
    confirmed: Bool[np.ndarray, "k"],
    options: MissingOptions,
) -> tuple[int, int]:
    """`missing` and `expected` of one direction, by the cells of the second photo."""
    pixels = image_from_cam(camera, unmatched_in_cam)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        inside = (unmatched_in_cam[:, 2] > 0) & np.all((pixels > 0) & (pixels < size), axis=1)
    alone = confirmed.copy()
    alone[matched] = False
    both = np.minimum(per_cell(pixels[inside], size, options), per_cell(keypoints[alone], size, options))
    with_match = per_cell(keypoints[matched], size, options)
    return int(both[with_match == 0].sum()), int(both.sum() + with_match.sum())


def per_cell(
    pixels: Float[np.ndarray, "p 2"], size: Int[np.ndarray, "2"], options: MissingOptions
) -> Int[np.ndarray, "c"]:
    """Number of pixels in every cell of every grid."""
    counts = []
    for columns, rows, shift in options.grids:
        column, row = np.clip((pixels / size * [columns, rows] + shift).astype(np.int64), 0, [columns, rows]).T
        counts.append(np.bincount(column * (rows + 1) + row, minlength=(columns + 1) * (rows + 1)))
    return np.concatenate(counts)


def _stars(graph: MatchGraph, bearings: Sequence[Float[np.ndarray, "_ 3"]]) -> list[list[_Neighbor]]:
    """The neighbours of every photo, those with most inliers first."""
    stars: list[list[_Neighbor]] = [[] for _ in range(graph.num_images)]
    for pair, two_view in sorted(graph.two_views.items()):
        pose = two_view.cam2_from_cam1
        if pose is None or not two_view.inliers.any():
            continue
        rows = graph.inlier_matches(pair)
        first, second = rows[:, 0], rows[:, 1]
        depth1, depth2, angle = _depths(pose, bearings[pair[0]][first], bearings[pair[1]][second])
        stars[pair[0]].append(_Neighbor(pair[1], pose, first, second, depth1, angle))
        stars[pair[1]].append(_Neighbor(pair[0], pose.inverse(), second, first, depth2, angle))
    return [sorted(star, key=lambda neighbor: (-len(neighbor.own), neighbor.view)) for star in stars]


def _depths(
    cam2_from_cam1: Rigid3, bearings1: Float[np.ndarray, "m 3"], bearings2: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Distances along both rays to where they are nearest to each other, and the angle between the rays."""
    a, b, t = bearings1 @ cam2_from_cam1.R.T, bearings2, cam2_from_cam1.t
    ab, at, bt = np.sum(a * b, axis=1), a @ t, b @ t
    sine2 = np.maximum(1.0 - ab**2, 1e-12)
    return (ab * bt - at) / sine2, (bt - ab * at) / sine2, np.arctan2(np.sqrt(sine2), ab)


def _one_scale(
    star: Sequence[_Neighbor], num_keypoints: int, options: MissingOptions
) -> tuple[Float[np.ndarray, "s"], Float[np.ndarray, "k"]]:
    """Length of every neighbour's baseline and depth of every keypoint, in one unit; nan where nothing tells."""
    log_depth = np.full((len(star), num_keypoints), np.nan)
    for row, neighbor in zip(log_depth, star, strict=True):
        good = (neighbor.depth > 0) & (neighbor.angle > np.deg2rad(options.min_parallax_deg))
        row[neighbor.own[good]] = np.log(neighbor.depth[good])
    has_depth = np.isfinite(log_depth)
    log_scale = np.full(len(star), np.nan)
    if not has_depth.any():
        return log_scale, np.full(num_keypoints, np.nan)
    log_scale[np.argmax(has_depth.sum(axis=1))] = 0.0
    while True:
        placed = np.isfinite(log_scale)
        known = _median_of_finite(log_depth[placed] + log_scale[placed, None])
        common = has_depth & np.isfinite(known)
        counts = np.where(placed, 0, common.sum(axis=1))
        if counts.max() < options.min_common_depths:
            return np.exp(log_scale), np.exp(known)
        for s in np.flatnonzero(counts >= max(options.min_common_depths, counts.max() // 2)):
            log_scale[s] = np.median(known[common[s]] - log_depth[s, common[s]])


def _median_of_finite(values: Float[np.ndarray, "s k"]) -> Float[np.ndarray, "k"]:
    """Median of every column without its nan; nan where nothing is left. `np.nanmedian` warns of each such column."""
    ordered = np.sort(values, axis=0)  # nan goes last
    count, column = np.isfinite(values).sum(axis=0), np.arange(values.shape[1])
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    return (ordered[low, column] + ordered[high, column]) / 2
