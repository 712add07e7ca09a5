"""Matches to two-view geometry: every pair verified on its own, in parallel, with the same result in any order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.solve.robust.focal_voting import FocalVote, vote_focal, vote_focal_of_rotations
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view

MAX_VOTING_PAIRS = 300


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


def calibrate_from_pairs(
    graph: MatchGraph,
    camera: Camera,
    images: Bool[np.ndarray, "n"],
    options: TwoViewOptions,
    seed: int,
    threads: int,
    max_pairs: int = MAX_VOTING_PAIRS,
) -> FocalVote | None:
    """A vote on the unknown focal length that some photos share, over those pairs among them with most matches.

    Returns:
        The focal length over the longer side of the photo; None if the pairs say nothing of it, as those of one plane.
    """
    pairs = [pair for pair in sorted(graph.matches) if images[pair[0]] and images[pair[1]]]
    pairs = sorted(pairs, key=lambda pair: (-len(graph.matches[pair]), pair))[:max_pairs]
    unit, (cx, cy) = float(max(camera.width, camera.height)), camera.principal_point
    pixels_from_unit = np.array([[unit, 0.0, cx], [0.0, unit, cy], [0.0, 0.0, 1.0]])
    uncalibrated, scale = replace(options, focal_known=False), graph.scale_of_image

    def geometry(pair: ImagePair) -> tuple[bool, Float[np.ndarray, "3 3"], float] | None:
        """Whether the pair has a fundamental matrix rather than a homography, the matrix, its number of inliers."""
        pixels1, pixels2 = graph.matched_pixels(pair)
        rng = np.random.default_rng([seed, *pair])
        scales = float(scale[pair[0]]), float(scale[pair[1]])
        found = estimate_two_view(camera, camera, pixels1, pixels2, uncalibrated, rng, pixel_scales=scales)
        inliers = float(found.inliers.sum())
        if found.kind == "uncalibrated":
            return True, pixels_from_unit.T @ found.matrix @ pixels_from_unit, inliers
        if found.kind in ("planar", "panoramic"):
            return False, np.linalg.inv(pixels_from_unit) @ found.matrix @ pixels_from_unit, inliers
        return None

    with ThreadPoolExecutor(threads) as pool:
        found = [result for result in pool.map(geometry, pairs) if result is not None]
    parallax, turning = ([(M, n) for is_F, M, n in found if is_F == wanted] for wanted in (True, False))
    if sum(n for _, n in turning) > sum(n for _, n in parallax):
        vote = vote_focal_of_rotations(np.array([H for H, _ in turning]), np.array([n for _, n in turning]))
        if vote is not None:
            return vote
    if not parallax:
        return None
    return vote_focal(np.array([F for F, _ in parallax]), np.array([n for _, n in parallax]))
