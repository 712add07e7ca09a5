"""Pairs verified once more, where a model found other focal lengths than those that they were verified with."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fieldstone.features.verification import two_views_of_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.mapping.model.calibration import FOCAL_SIGMA
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photos_to_graph import MatchedPhotos

logger = logging.getLogger(__name__)

CLEAR_CHANGE = 1.25
"""Focal lengths that a model changes by less than this factor hardly change which matches agree."""
MIN_GAIN = 1.05
"""Factor on the matches that agree from which on photos are mapped anew."""


def with_cameras_of_models(
    matched: MatchedPhotos, sub_models: Sequence[SubModel], options: MatchingOptions, seed: int
) -> MatchedPhotos | None:
    """The photos with the focal lengths that sub-models found, and pairs verified with these.

    With a focal length that is far off, verification takes false matches for true ones and loses true ones: a model
    of what is left tells the focal length well all the same, since it has many photos.

    Returns:
        None where focal lengths are about the same, or no more matches agree.
    """
    cameras, changed = _cameras_of(matched, sub_models)
    if not changed:
        return None
    graph = matched.graph
    pairs = [pair for pair in sorted(graph.matches) if changed & {int(matched.camera_of_image[k]) for k in pair}]
    found = two_views_of_pairs(graph, pairs, cameras, matched.camera_of_image, options.two_view, seed, options.threads)
    again = graph.with_two_views({**graph.two_views, **dict(zip(pairs, found, strict=True))})
    before, after = (sum(int(g.two_views[pair].inliers.sum()) for pair in pairs) for g in (graph, again))
    logger.info("with the focal lengths of the model %d matches agree instead of %d", after, before)
    if after <= MIN_GAIN * before:
        return None
    sigma = matched.focal_sigma.copy()
    sigma[sorted(changed)] = FOCAL_SIGMA  # what was known before is not true
    return replace(matched, graph=again, cameras=cameras, focal_sigma=sigma)


def _cameras_of(matched: MatchedPhotos, sub_models: Sequence[SubModel]) -> tuple[tuple[Camera, ...], set[int]]:
    """Cameras with the focal lengths of the largest sub-model that has photos of them, and which have changed clearly.

    Distortion and principal points are left as they were: it is the focal length that decides on a pair.
    """
    cameras, changed = list(matched.cameras), set()
    for c, camera in enumerate(cameras):
        photos = matched.camera_of_image == c
        home = max(sub_models, key=lambda s: int(np.sum(s.model.registered & photos)), default=None)
        if home is None or matched.known[c] or not np.any(home.model.registered & photos):
            continue
        factor = float(home.model.cameras[c].focal.mean() / camera.focal.mean())
        if max(factor, 1.0 / factor) > CLEAR_CHANGE:
            params = camera.params.copy()
            params[: camera.spec.num_focal] *= factor
            cameras[c] = replace(camera, params=params)
            changed.add(c)
    return tuple(cameras), changed
