"""Matches to two-view geometry: every pair verified on its own, in parallel, with the same result in any order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.epipolar import (
    essential_from_pose,
    fundamental_from_essential,
    homogeneous,
    sampson_error,
)
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.solve.averaging.focal_lengths import PairEvidence
from fieldstone.solve.robust.fundamental_covariance import fundamental_covariance, with_rank_two
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view


def verify_pairs(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: TwoViewOptions,
    seed: int,
    threads: int,
    on_progress: OnProgress = silent,
) -> MatchGraph:
    """The graph with the geometry and inliers of every pair, for cameras whose focal length is known well enough.

    The kernels release the interpreter lock, so threads run side by side. The random numbers of pair (i, j) depend on
    the seed, i and j alone.
    """
    pairs = sorted(graph.matches)
    progress = StageProgress(on_progress, "verifying pairs", len(pairs))
    found = two_views_of_pairs(graph, pairs, cameras, camera_of_image, options, seed, threads)
    return graph.with_two_views(dict(zip(pairs, progress.each(found), strict=True)))


def two_views_of_pairs(
    graph: MatchGraph,
    pairs: Sequence[ImagePair],
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: TwoViewOptions,
    seed: int,
    threads: int,
) -> Iterator[TwoView]:
    """Geometry of these pairs, in their order, each as soon as it is known."""

    scale = graph.scale_of_image

    def verify(pair: ImagePair) -> TwoView:
        camera1, camera2 = (cameras[camera_of_image[k]] for k in pair)
        pixels1, pixels2 = graph.matched_pixels(pair)
        scales = float(scale[pair[0]]), float(scale[pair[1]])
        rng = np.random.default_rng([seed, *pair])
        return estimate_two_view(camera1, camera2, pixels1, pixels2, options, rng, pixel_scales=scales)

    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(verify, pairs)


def voting_pairs(graph: MatchGraph, max_pairs: int, per_photo: int) -> list[ImagePair]:
    """Pairs to ask for focal lengths: those with most matches, but some of every photo first.

    Args:
        max_pairs: Exceeded where `per_photo` pairs of every photo are more.
        per_photo: How many of the best pairs of each photo are among them.
    """
    ranked = sorted(graph.matches, key=lambda pair: (-len(graph.matches[pair]), pair))
    count, first, others = [0] * graph.num_images, [], []
    for pair in ranked:
        (first if min(count[k] for k in pair) < per_photo else others).append(pair)
        for k in pair:
            count[k] += 1
    return sorted(first + others[: max(max_pairs - len(first), 0)])


@dataclass(frozen=True, eq=False)
class UncalibratedPairs:
    """Geometry of pairs of photos whose focal lengths are not known, in units of the photos' longer sides."""

    parallax: PairEvidence
    turning: tuple[tuple[ImagePair, Float[np.ndarray, "3 3"]], ...]
    """Pairs that one homography explains, and this homography: of a plane, or of a camera that turned."""
    inliers: Mapping[ImagePair, int]


def uncalibrated_pairs(
    graph: MatchGraph,
    pairs: Sequence[ImagePair],
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: TwoViewOptions,
    seed: int,
    threads: int,
) -> UncalibratedPairs:
    """Fundamental matrices of pairs, with their covariances, or homographies; only the size of the cameras matters."""
    uncalibrated, scale = replace(options, focal_known=False), graph.scale_of_image
    found = list(two_views_of_pairs(graph, pairs, cameras, camera_of_image, uncalibrated, seed, threads))
    kept, fundamentals, covariances, turning = [], [], [], []
    for pair, two_view in zip(pairs, found, strict=True):
        of_pair = [cameras[camera_of_image[k]] for k in pair]
        units = [float(max(camera.width, camera.height)) for camera in of_pair]
        T1, T2 = (
            np.array([[unit, 0.0, camera.width / 2], [0.0, unit, camera.height / 2], [0.0, 0.0, 1.0]])
            for camera, unit in zip(of_pair, units, strict=True)
        )
        if two_view.kind == "uncalibrated":
            F = with_rank_two(T2.T @ two_view.matrix @ T1)
            pixels = graph.matched_pixels(pair, graph.matches[pair][two_view.inliers])
            x1, x2 = ((px - T[:2, 2]) / unit for px, T, unit in zip(pixels, (T1, T2), units, strict=True))
            kept.append(pair)
            fundamentals.append(F)
            covariances.append(
                fundamental_covariance(F, x1, x2, (float(scale[pair[0]] / units[0]), float(scale[pair[1]] / units[1])))
            )
        elif two_view.kind in ("planar", "panoramic"):
            turning.append((pair, np.linalg.inv(T2) @ two_view.matrix @ T1))
    parallax = PairEvidence(
        np.array(kept, dtype=np.int64).reshape(-1, 2),
        np.array(fundamentals).reshape(-1, 3, 3),
        np.array(covariances).reshape(-1, 9, 9),
    )
    inliers = {pair: int(two_view.inliers.sum()) for pair, two_view in zip(pairs, found, strict=True)}
    return UncalibratedPairs(parallax, tuple(turning), inliers)


def misfits(
    graph: MatchGraph,
    pairs: Sequence[ImagePair],
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: TwoViewOptions,
    seed: int,
    threads: int,
) -> Float[np.ndarray, "p"]:
    """How badly the matches of each pair fit the best geometry that the cameras allow.

    Squared Sampson errors over the squared threshold, each 1 at most, added up over all matches (the score of
    `torr2000`).
    """
    scale, limit = graph.scale_of_image, options.ransac.max_error_px**2

    def misfit(pair: ImagePair, two_view: TwoView) -> float:
        if two_view.cam2_from_cam1 is None or not np.any(two_view.cam2_from_cam1.t):
            return float(np.sum(~two_view.inliers))
        E = essential_from_pose(two_view.cam2_from_cam1)
        K1, K2 = (
            np.diag([1 / scale[k], 1 / scale[k], 1.0]) @ cameras[camera_of_image[k]].calibration_matrix() for k in pair
        )
        x1, x2 = (homogeneous(px / scale[k]) for k, px in zip(pair, graph.matched_pixels(pair), strict=True))
        return float(np.minimum(sampson_error(fundamental_from_essential(E, K1, K2), x1, x2) / limit, 1.0).sum())

    found = two_views_of_pairs(graph, pairs, cameras, camera_of_image, options, seed, threads)
    return np.array([misfit(pair, two_view) for pair, two_view in zip(pairs, found, strict=True)])
