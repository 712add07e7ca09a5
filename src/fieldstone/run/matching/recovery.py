"""More matches for photos that no model took in: other pairs, guided matching along epipolar lines, more features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from fieldstone.features.guided_numba import match_guided_numba
from fieldstone.features.pairs import preview_counts
from fieldstone.features.sift import Sift
from fieldstone.features.verification import two_views_of_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.run.matching.detection import DetectedPhoto, opencv_threads
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.pairs import match_pair
from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import ImagePair, MatchGraph

PARTNERS = 20
"""Photos of the model that each unregistered photo is matched with."""
MAX_RECOVERED = 40
"""No more photos than these are matched again: a folder of strangers must not take for ever."""
MORE_FEATURES = 2.0
"""Factor on the number of features, and on the contrast below which they are dropped, for the last stage."""


@dataclass(frozen=True, eq=False)
class Unregistered:
    """Photos that need matches, those that a model holds, and the cameras as the model knows them."""

    photos: tuple[int, ...]
    registered: Bool[np.ndarray, "n"]
    cameras: tuple[Camera, ...]

    def pairs_with_model(self) -> list[ImagePair]:
        """Every unregistered photo, up to `MAX_RECOVERED`, with every photo of the model."""
        registered = np.flatnonzero(self.registered).tolist()
        return [(min(v, r), max(v, r)) for v in self.photos[:MAX_RECOVERED] for r in registered]


RecoveryStage = Callable[[MatchGraph, Unregistered], MatchGraph | None]
"""A verified graph with more matches of the unregistered photos; None if there are none. Other photos keep their
keypoints."""


@dataclass(frozen=True, eq=False)
class Rematcher:
    """Matches unregistered photos of a set anew."""

    photos: Sequence[DetectedPhoto]
    camera_of_image: Int[np.ndarray, "n"]
    options: MatchingOptions
    seed: int

    def stages(self) -> tuple[RecoveryStage, ...]:
        """From cheap to expensive."""
        return self.other_pairs, self.along_epipolar_lines, self.more_features

    def other_pairs(self, graph: MatchGraph, unregistered: Unregistered) -> MatchGraph | None:
        """The unregistered photos matched with those of the model that look most alike and have not been tried."""
        features = [photo.features for photo in self.photos]
        pairs = [pair for pair in unregistered.pairs_with_model() if pair not in graph.matches]
        return self._matched(graph, features, self._promising(features, pairs, unregistered.photos), unregistered)

    def along_epipolar_lines(self, graph: MatchGraph, unregistered: Unregistered) -> MatchGraph | None:
        """Pairs of an unregistered photo with a known geometry, matched again among what agrees with it."""
        options, chosen, matches = self.options, [], []
        for pair in unregistered.pairs_with_model():
            two_view = graph.two_views.get(pair)
            if two_view is None or two_view.kind != "calibrated":
                continue
            # Over the pixel scales, so that one threshold serves both photos.
            scales = graph.scale_of_image[list(pair)]
            K1, K2 = (
                np.diag([1 / s, 1 / s, 1.0]) @ unregistered.cameras[self.camera_of_image[v]].calibration_matrix()
                for v, s in zip(pair, scales, strict=True)
            )
            F = np.linalg.inv(K2).T @ two_view.matrix @ np.linalg.inv(K1)
            a, b = (
                replace(self.photos[v].features, keypoints=graph.keypoints[v] / s)
                for v, s in zip(pair, scales, strict=True)
            )
            rows = match_guided_numba(a, b, F, options.two_view.ransac.max_error_px, options.max_ratio)
            if len(rows) > two_view.inliers.sum():
                chosen.append(pair)
                matches.append(rows)
        return self._verified(graph, chosen, matches, unregistered)

    def more_features(self, graph: MatchGraph, unregistered: Unregistered) -> MatchGraph | None:
        """The unregistered photos with more and weaker features, matched anew."""
        sift = self.options.sift
        richer = Sift(
            replace(
                sift,
                max_features=round(MORE_FEATURES * sift.max_features),
                contrast_threshold=sift.contrast_threshold / MORE_FEATURES,
                coarse_ratio=1.0,
            )
        )
        features = [photo.features for photo in self.photos]
        keypoints, colors = list(graph.keypoints), list(graph.colors)
        photos = unregistered.photos[:MAX_RECOVERED]
        with opencv_threads(1), ThreadPoolExecutor(self.options.threads) as pool:
            found = list(pool.map(lambda v: richer(*self.photos[v].pixels()), photos))
        for v, of_photo in zip(photos, found, strict=True):
            features[v], keypoints[v], colors[v] = of_photo, of_photo.keypoints, of_photo.colors
        graph = replace(
            graph,
            keypoints=tuple(keypoints),
            colors=tuple(colors),
            matches={pair: rows for pair, rows in graph.matches.items() if not set(pair) & set(photos)},
            two_views={pair: found for pair, found in graph.two_views.items() if not set(pair) & set(photos)},
        )
        return self._matched(
            graph, features, self._promising(features, unregistered.pairs_with_model(), photos), unregistered
        )

    def _promising(
        self, features: Sequence[Features], pairs: list[ImagePair], photos: Sequence[int]
    ) -> list[ImagePair]:
        """Of every unregistered photo, the pairs with most matches among the largest features."""
        counts = preview_counts(features, pairs, self.options.pairs, threads=self.options.threads)
        ranked = [pairs[k] for k in np.argsort(-counts, kind="stable").tolist()]
        return sorted({pair for v in photos for pair in [pair for pair in ranked if v in pair][:PARTNERS]})

    def _matched(
        self, graph: MatchGraph, features: Sequence[Features], pairs: list[ImagePair], unregistered: Unregistered
    ) -> MatchGraph | None:
        with ThreadPoolExecutor(self.options.threads) as pool:
            ratio = self.options.max_ratio
            found = list(pool.map(lambda pair: match_pair(self.photos, features, pair, ratio), pairs))
        return self._verified(graph, pairs, found, unregistered)

    def _verified(
        self,
        graph: MatchGraph,
        pairs: Sequence[ImagePair],
        matches: Sequence[Int[np.ndarray, "_ 2"]],
        unregistered: Unregistered,
    ) -> MatchGraph | None:
        """The graph with these matches in place of what the pairs had; None without any."""
        new = {pair: rows for pair, rows in zip(pairs, matches, strict=True) if len(rows)}
        if not new:
            return None
        graph = replace(graph, matches={**graph.matches, **new})
        options = self.options
        found = two_views_of_pairs(
            graph, list(new), unregistered.cameras, self.camera_of_image, options.two_view, self.seed, options.threads
        )
        return graph.with_two_views({**graph.two_views, **dict(zip(new, found, strict=True))})
