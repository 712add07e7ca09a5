"""Photos with known cameras, as scene files list them: not yet decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from fieldstone.io.images.photos import PhotoProblem
from fieldstone.scene.photos import PosedPhotos
from fieldstone.scene.reconstruction import Reconstruction


@dataclass(frozen=True, eq=False)
class PosedScene:
    """What scene files describe: photos that are not yet decoded, and what is known of the scene."""

    photos: PosedPhotos
    """All photos that are there, with the paths of their files."""
    splits: Mapping[str, Int[np.ndarray, "_"]] = field(default_factory=dict)
    """Indices of the photos that the files call train, val or test; empty: they do not say."""
    points_in_world: Float[np.ndarray, "p 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Known points; may be none."""
    box: Float[np.ndarray, "2 3"] | None = None
    """Lower and upper corner of all there is, in the world; None: unknown, or without bounds."""
    depth_range: tuple[float, float] | None = None
    """Where rays begin and end, in the units of the world, if the format says so."""
    model: Reconstruction | None = None
    """The reconstruction that the photos are views of, if they are."""
    view_of_photo: Int[np.ndarray, "v"] | None = None
    """The view of that model that each photo is."""
    problems: tuple[PhotoProblem, ...] = ()
    """Photos that the files name and that are missing or no images."""

    def held_out(self) -> Int[np.ndarray, "_"]:
        """Photos that the files call test, else val; may be none."""
        return next((self.splits[name] for name in ("test", "val") if len(self.splits.get(name, ()))), NO_PHOTO)


NO_PHOTO = np.empty(0, dtype=np.int64)
