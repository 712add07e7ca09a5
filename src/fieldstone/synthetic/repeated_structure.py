"""Places of which parts look alike, and what a matcher finds in photos of them: true matches and false ones.

Every point has a look, and points of equal looks cannot be told apart in photos that see them from about the same side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations

MAX_OBLIQUENESS_DEG = 70.0
"""A facade that is seen more obliquely has no features."""


@dataclass(frozen=True, eq=False)
class RepeatedPlace:
    """Points, the direction in plan that each faces (nan: any), and the look of each: equal numbers look alike."""

    xyz: Float[np.ndarray, "p 3"]
    facing: Float[np.ndarray, "p"]
    look: Int[np.ndarray, "p"]


@dataclass(frozen=True)
class PhotographOptions:
    """How photos show points, and what their descriptors tell."""

    camera: Camera
    visibility: float
    """Probability that a photo has a keypoint where it sees a point."""
    max_view_change_deg: float
    """Descriptors of one feature are alike while its azimuths of view differ by less."""
    noise_px: float


@dataclass(frozen=True, eq=False)
class RepeatedScene:
    """The truth, what a matcher finds, and which of the matches join keypoints of one point."""

    truth: Reconstruction
    graph: MatchGraph
    true_matches: dict[ImagePair, Bool[np.ndarray, "_"]]

    def is_true(self, pair: ImagePair) -> bool:
        """Whether most of a pair's matches are true."""
        return bool(np.mean(self.true_matches[pair]) > 0.5)


def photograph_repeated(
    place: RepeatedPlace,
    poses: Rigid3,
    sees: Callable[[Rigid3], Bool[np.ndarray, "p"]],
    options: PhotographOptions,
    rng: np.random.Generator,
) -> RepeatedScene:
    """Exact poses, noisy keypoints, and the matches that the ratio test leaves.

    A feature that has two equal candidates in the other photo matches neither.

    Args:
        poses: `cam_from_world`, a batch.
        sees: Which points a photo of this pose shows.
    """
    n = len(poses.R)
    keypoints, owners, views = [], [], []
    for k in range(n):
        mine = rng.permutation(np.flatnonzero(sees(poses[k])))
        mine = mine[rng.uniform(size=len(mine)) < options.visibility]
        exact = image_from_cam(options.camera, poses[k].apply(place.xyz[mine]))
        keypoints.append(exact + options.noise_px * rng.normal(size=exact.shape))
        owners.append(mine)
        views.append(_azimuth_of_view(poses[k], place, mine))
    matches, true_matches = {}, {}
    for i in range(n):
        for j in range(i + 1, n):
            first, second = (place.look[owners[k]] for k in (i, j))
            rows = _ratio_test(first, second, views[i], views[j], np.deg2rad(options.max_view_change_deg))
            if len(rows):
                matches[i, j] = rows
                true_matches[i, j] = owners[i][rows[:, 0]] == owners[j][rows[:, 1]]
    names = tuple(f"photo_{k:04d}.png" for k in range(n))
    grey = tuple(np.full((len(k), 3), 128, dtype=np.uint8) for k in keypoints)
    points = Points(place.xyz, np.full((len(place.xyz), 3), 128, dtype=np.uint8))
    posed = tuple(View(name, 0, poses[k]) for k, name in enumerate(names))
    truth = Reconstruction((options.camera,), posed, points, Observations.empty())
    return RepeatedScene(truth, MatchGraph(names, tuple(keypoints), grey, matches), true_matches)


def in_view(camera: Camera, cam_from_world: Rigid3, place: RepeatedPlace) -> Bool[np.ndarray, "p"]:
    """In the image, and on the side of its wall that the camera looks at."""
    in_cam = cam_from_world.apply(place.xyz)
    pixels = image_from_cam(camera, in_cam)
    inside = (in_cam[:, 2] > 0.1) & np.all((pixels > 1) & (pixels < [camera.width - 1, camera.height - 1]), axis=1)
    towards = cam_from_world.target_origin_in_source() - place.xyz
    normal = np.stack([np.cos(place.facing), np.sin(place.facing), np.zeros(len(place.xyz))], axis=1)
    cosine = np.sum(normal * towards, axis=1) / np.linalg.norm(towards, axis=1)
    return inside & (~np.isfinite(place.facing) | (cosine > np.cos(np.deg2rad(MAX_OBLIQUENESS_DEG))))


def _azimuth_of_view(
    cam_from_world: Rigid3, place: RepeatedPlace, points: Int[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """From which side each point is seen, relative to the facade that it lies on."""
    towards = cam_from_world.target_origin_in_source() - place.xyz[points]
    return np.arctan2(towards[:, 1], towards[:, 0]) - np.nan_to_num(place.facing[points])


def _ratio_test(
    look1: Int[np.ndarray, "a"],
    look2: Int[np.ndarray, "b"],
    azimuth1: Float[np.ndarray, "a"],
    azimuth2: Float[np.ndarray, "b"],
    max_change: float,
) -> Int[np.ndarray, "m 2"]:
    """Pairs that look alike, each of which has no other candidate in the other photo."""
    order = np.argsort(look2, kind="stable")
    low = np.searchsorted(look2[order], look1, side="left")
    high = np.searchsorted(look2[order], look1, side="right")
    a = np.repeat(np.arange(len(look1)), high - low)
    b = order[np.concatenate([np.arange(x, y) for x, y in zip(low, high, strict=True)] or [np.empty(0, dtype=int)])]
    change = np.abs(np.angle(np.exp(1j * (azimuth1[a] - azimuth2[b]))))
    a, b = a[change < max_change], b[change < max_change]
    alone = (np.bincount(a, minlength=len(look1))[a] == 1) & (np.bincount(b, minlength=len(look2))[b] == 1)
    return np.stack([a[alone], b[alone]], axis=1).astype(np.int64)
