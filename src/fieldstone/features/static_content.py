"""What stands still in every photo while the scene moves: overlays, watermarks, the background of a turntable.

A match between two photos whose displacement is zero belongs to the scene only if the scene's own motion leaves that
place where it is. So the geometry of a pair is found from the matches that did move; a match that did not, at a place
that must have moved, belongs to something that is fixed to the camera. Two such pairs are needed for every feature: a
camera that stood still for a while, a panorama, or a far horizon show none, and one pair alone cannot tell a moving
object from a moving camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.epipolar import homogeneous, sampson_error
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view

CELLS = 64
"""Of the grid on which what stands still is drawn, along the longer side of a photo."""


@dataclass(frozen=True)
class StaticOptions:
    """When something counts as fixed to the camera. Pixels are those of the detector."""

    still_px: float = 1.0
    """A keypoint found twice at one place is found within this distance."""
    moved_px: float = 4.0
    """A match with a larger displacement has moved beyond doubt."""
    contradiction_px: float = 3.0
    """How far from where it stands a match must have gone, by the geometry of the pair, to contradict it."""
    min_still: int = 8
    """Fewer matches that stand still are no peak, whatever stands around them."""
    min_pairs: int = 2
    """So many pairs must contradict a feature before it is left out."""
    max_scene_share: float = 0.1
    """What stands still may have this share of features that move with the scene, within a photo and within a cell."""


@dataclass(frozen=True, eq=False)
class StaticContent:
    """What is fixed to the camera."""

    features: tuple[Bool[np.ndarray, "_"], ...]
    """Of every photo, the features that do not belong to the scene."""
    regions: tuple[Bool[np.ndarray, "_ _"] | None, ...]
    """Of every photo, the cells (`CELLS`) in which nothing belongs to the scene; None: in all of them something may."""
    num_pairs: int
    """Pairs of photos that show it."""
    decided: bool
    """Whether any pair shows it; if not, most pairs stand still and nothing else moves."""

    @property
    def share(self) -> float:
        """Largest share of a photo that the regions cover."""
        return max((float(cells.mean()) for cells in self.regions if cells is not None), default=0.0)


@dataclass(eq=False)
class _Votes:
    """Per feature of every photo: pairs in which it contradicts the scene, and in which it moves with it."""

    against: list[Int[np.ndarray, "_"]]
    moving: list[Int[np.ndarray, "_"]]
    """In pairs in which something stands still."""
    moving_elsewhere: list[Int[np.ndarray, "_"]]
    """In pairs in which nothing does: the same features are scene as soon as the camera moves."""
    num_pairs: int = 0
    """In which a feature contradicts the scene."""

    @staticmethod
    def none(graph: MatchGraph) -> _Votes:
        """Before any pair was asked."""
        against, moving, elsewhere = ([np.zeros(len(k), dtype=np.int64) for k in graph.keypoints] for _ in range(3))
        return _Votes(against, moving, elsewhere)


def find_static_content(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    two_view: TwoViewOptions,
    seed: int,
    threads: int,
    options: StaticOptions | None = None,
) -> StaticContent | None:
    """Features and regions that are fixed to the camera, from putative matches; None if nothing stands still.

    Args:
        graph: Putative matches.
        cameras: Of every photo. Only photos of one size are compared; focal lengths are used for nothing but scale.
    """
    options = options or StaticOptions()
    sizes = [(camera.width, camera.height) for camera in cameras]
    pairs = [pair for pair in sorted(graph.matches) if sizes[pair[0]] == sizes[pair[1]]]
    with_peak = [pair for pair in pairs if _has_peak(_displacement(graph, pair), options)]
    if not with_peak:
        return None
    votes = _Votes.none(graph)
    count = partial(_count_votes, graph, cameras, two_view, seed, threads, options)
    count(with_peak, votes, has_peak=True)
    if not votes.num_pairs:
        nothing = tuple(np.zeros(len(k), dtype=bool) for k in graph.keypoints)
        most = len(with_peak) > len(pairs) / 2
        return StaticContent(nothing, (None,) * graph.num_images, 0, decided=False) if most else None
    count(sorted(set(pairs) - set(with_peak)), votes, has_peak=False)
    features = _static_features(graph, with_peak, votes, options)
    if not any(static.any() for static in features):
        return None
    regions = _static_regions(graph, sizes, features, votes, options)
    inside = (_in_cells(cells, graph.keypoints[k], sizes[k]) for k, cells in enumerate(regions))
    features = tuple(static | within for static, within in zip(features, inside, strict=True))
    return StaticContent(features, regions, votes.num_pairs, decided=True)


def _displacement(graph: MatchGraph, pair: ImagePair) -> Float[np.ndarray, "m"]:
    """Of every match, in pixels of the detector."""
    pixels1, pixels2 = graph.matched_pixels(pair)
    return np.linalg.norm(pixels2 - pixels1, axis=1) / float(graph.scale_of_image[list(pair)].max())


def _has_peak(displacement: Float[np.ndarray, "m"], options: StaticOptions) -> bool:
    """Whether matches stand still while next to none moves a little.

    A scene that moves slowly has a smooth distribution of displacements: the ring between the two radii has fifteen
    times the area of the disc, and three times its width, so that it has more of the matches.
    """
    still = int(np.sum(displacement < options.still_px))
    return still >= options.min_still and still > int(np.sum(displacement < options.moved_px)) - still


def _count_votes(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    two_view: TwoViewOptions,
    seed: int,
    threads: int,
    options: StaticOptions,
    pairs: Sequence[ImagePair],
    votes: _Votes,
    *,
    has_peak: bool,
) -> None:
    """Add what every pair says, by the geometry of those of its matches that moved."""
    uncalibrated = replace(two_view, focal_known=False)

    def geometry(pair: ImagePair) -> TwoView:
        camera1, camera2 = (cameras[k] for k in pair)
        moved = _displacement(graph, pair) >= options.moved_px
        pixels1, pixels2 = graph.matched_pixels(pair, graph.matches[pair][moved])
        scales = float(graph.scale_of_image[pair[0]]), float(graph.scale_of_image[pair[1]])
        rng = np.random.default_rng([seed, *pair])
        return estimate_two_view(camera1, camera2, pixels1, pixels2, uncalibrated, rng, pixel_scales=scales)

    with ThreadPoolExecutor(threads) as pool:
        for pair, found in zip(pairs, pool.map(geometry, pairs), strict=True):
            if found.kind != "degenerate":
                _vote(graph, pair, found, votes, options, has_peak=has_peak)


def _vote(
    graph: MatchGraph, pair: ImagePair, found: TwoView, votes: _Votes, options: StaticOptions, *, has_peak: bool
) -> None:
    """Add what one pair says of its features."""
    rows, displacement = graph.matches[pair], _displacement(graph, pair)
    moved = rows[displacement >= options.moved_px][found.inliers]
    still = rows[displacement < options.still_px]
    if has_peak:
        against = still[_contradicts(graph, pair, still, found, options)]
        votes.num_pairs += bool(len(against))
        for column, k in enumerate(pair):
            votes.against[k][against[:, column]] += 1
    for column, k in enumerate(pair):
        (votes.moving if has_peak else votes.moving_elsewhere)[k][moved[:, column]] += 1


def _contradicts(
    graph: MatchGraph, pair: ImagePair, rows: Int[np.ndarray, "m 2"], found: TwoView, options: StaticOptions
) -> Bool[np.ndarray, "m"]:
    """Whether the geometry of what moved denies that these matches are where they are."""
    pixels1, pixels2 = graph.matched_pixels(pair, rows)
    if found.kind == "uncalibrated":
        error = np.sqrt(sampson_error(found.matrix, homogeneous(pixels1), homogeneous(pixels2)))
    else:
        moved = homogeneous(pixels1) @ found.matrix.T
        error = np.linalg.norm(moved[:, :2] / moved[:, 2:] - pixels2, axis=1)
    return error / float(graph.scale_of_image[list(pair)].max()) > options.contradiction_px


def _static_features(
    graph: MatchGraph, with_peak: Sequence[ImagePair], votes: _Votes, options: StaticOptions
) -> tuple[Bool[np.ndarray, "_"], ...]:
    """Features that contradict the scene in several pairs, and those that stand still with them.

    A feature that moves with the scene where nothing stands still is the scene, seen by a camera that rested for a
    while. One that is said to move where something does stand still may be a sign among others like it.
    """
    scene = [elsewhere > 0 for elsewhere in votes.moving_elsewhere]
    seeds = []
    for against, moving, of_scene in zip(votes.against, votes.moving, scene, strict=True):
        static = (against >= options.min_pairs) & (against > moving)
        # Where many of them are scene elsewhere, the others are scene that was not seen from elsewhere.
        rested = np.sum(static & of_scene) > options.max_scene_share * np.sum(static)
        seeds.append(np.zeros_like(static) if rested else static & ~of_scene)
    features = [static.copy() for static in seeds]
    for i, j in with_peak:
        rows = graph.matches[i, j]
        rows = rows[_displacement(graph, (i, j)) < options.still_px]
        features[i][rows[seeds[j][rows[:, 1]], 0]] = True
        features[j][rows[seeds[i][rows[:, 0]], 1]] = True
    moves = [scene[k] | (votes.moving[k] > votes.against[k]) for k in range(graph.num_images)]
    return tuple(static & ~moving for static, moving in zip(features, moves, strict=True))


def _static_regions(
    graph: MatchGraph,
    sizes: Sequence[tuple[int, int]],
    features: Sequence[Bool[np.ndarray, "_"]],
    votes: _Votes,
    options: StaticOptions,
) -> tuple[Bool[np.ndarray, "_ _"] | None, ...]:
    """Cells that hold features which stand still and hardly any of the scene, in all photos of one size together.

    Gaps of one cell are closed where nothing of the scene is seen: a clock has digits that change.
    """
    regions: dict[tuple[int, int], Bool[np.ndarray, "_ _"] | None] = {}
    for size in sorted(set(sizes)):
        still, scene = np.zeros((2, *_grid(size)), dtype=np.int64)
        for k in (k for k, other in enumerate(sizes) if other == size):
            row, column = _cell(graph.keypoints[k], size)
            moves = ~features[k] & (votes.moving[k] + votes.moving_elsewhere[k] > 0)
            np.add.at(still, (row[features[k]], column[features[k]]), 1)
            np.add.at(scene, (row[moves], column[moves]), 1)
        stands = (still > options.min_pairs) & (scene <= options.max_scene_share * still)
        closed = cv2.morphologyEx(stands.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8)) > 0
        cells = stands | (closed & (scene == 0))
        regions[size] = cells if cells.any() else None
    return tuple(regions[size] for size in sizes)


def _grid(size: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the cells of a photo of this width and height."""
    width, height = (max(round(CELLS * side / max(size)), 1) for side in size)
    return height, width


def _cell(
    keypoints: Float[np.ndarray, "n 2"], size: tuple[int, int]
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Row and column of the cell in which each keypoint lies."""
    rows, columns = _grid(size)
    column, row = (keypoints * (np.array([columns, rows]) / size)).astype(np.int64).T
    return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


def _in_cells(
    cells: Bool[np.ndarray, "_ _"] | None, keypoints: Float[np.ndarray, "n 2"], size: tuple[int, int]
) -> Bool[np.ndarray, "n"]:
    """Keypoints in cells that stand still."""
    return np.zeros(len(keypoints), dtype=bool) if cells is None else cells[_cell(keypoints, size)]
