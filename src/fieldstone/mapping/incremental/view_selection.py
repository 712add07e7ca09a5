"""Which photo to register next: the one that sees many points, spread over its area."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.model.working_model import WorkingModel

LEVELS = 6
CANDIDATES = 8
"""Photos with most visible points whose spread is looked at."""


def next_view(model: WorkingModel, excluded: frozenset[int], min_points: int) -> int | None:
    """The unregistered photo that sees at least `min_points` points, spread best; None if there is none.

    Only the photos with most points compete by spread, which is what costs time.
    """
    seen = model.visible_points_per_view()
    waiting = np.flatnonzero(~model.registered & (seen >= min_points)).tolist()
    waiting = sorted((v for v in waiting if v not in excluded), key=lambda v: (-seen[v], v))[:CANDIDATES]
    scores = {v: spread(model.camera_of(v), model.tracks.pixels[model.observations_of(v)]) for v in waiting}
    return min(waiting, key=lambda v: (-scores[v], v), default=None)


def spread(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> int:
    """Visibility score: on grids of 2 x 2 to 64 x 64 cells, every cell with a point counts the cells of its grid.

    Source:
        `schonberger2016`, section 4.2.
    """
    relative = np.clip(pixels / np.array([camera.width, camera.height]), 0.0, 1.0 - 1e-9)
    score = 0
    for level in range(1, LEVELS + 1):
        cells = 2**level
        x, y = (relative * cells).astype(np.int64).T
        score += len(np.unique(x * cells + y)) * cells * cells
    return score
