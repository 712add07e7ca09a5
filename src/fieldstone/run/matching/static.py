"""Photos without what does not move with the scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from fieldstone.features.static_content import StaticContent, find_static_content
from fieldstone.geometry.camera import Camera
from fieldstone.run.matching.detection import DetectedPhoto
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.scene.match_graph import MatchGraph

logger = logging.getLogger(__name__)


def without_static_content(
    photos: Sequence[DetectedPhoto],
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: MatchingOptions,
    seed: int,
) -> tuple[Sequence[DetectedPhoto], list[str]]:
    """The photos, less their features that are fixed to the camera, and one line on what was left out.

    Returns:
        The photos themselves, where every feature may belong to the scene.
    """
    of_photo = [cameras[c] for c in camera_of_image.tolist()]
    found = find_static_content(graph, of_photo, options.two_view, seed, options.threads)
    if found is None:
        return photos, []
    note = _note(found, len(photos))
    logger.warning("%s", note)
    if not found.decided:
        return photos, [note]
    parts = zip(photos, found.features, found.regions, strict=True)
    return [photo.without(static, cells) if static.any() else photo for photo, static, cells in parts], [note]


def _note(found: StaticContent, num_photos: int) -> str:
    """What a user should know of it."""
    if not found.decided:
        return (
            "most pairs of photos show no motion, and nothing else moves in them: either the camera stood still, or "
            "something is fixed to it; move the camera, or give masks"
        )
    with_any = sum(bool(static.any()) for static in found.features)
    features = float(np.mean(np.concatenate(found.features)))
    return (
        f"something does not move with the scene (an overlay, a watermark, a background that stands still): "
        f"{100 * features:.0f} % of the features, and {100 * found.share:.0f} % of the area, of {with_any} of "
        f"{num_photos} photos are left out; {found.num_pairs} pairs show it"
    )
