"""Photos with known cameras, as scene files list them: not yet decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.io.images.photos import PhotoProblem
from fieldstone.scene.photos import PosedPhotos
from fieldstone.scene.reconstruction import Reconstruction

CV_FROM_GL = np.diag([1.0, -1.0, -1.0])

MAX_DEVIATION = 1e-3
"""Of R^T R from the identity; files hold float32, which is far better."""


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


def rigid_from_gl(matrix: np.ndarray) -> Rigid3:
    """`cam_from_world` with our axes of a world_from_camera matrix with OpenGL axes (x right, y up, looking along -z).

    Raises:
        ValueError: Not a finite rigid motion; the message says what is wrong.
    """
    if matrix.shape != (4, 4):
        raise ValueError(f"it must be 4x4, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError("it is not finite")
    R = matrix[:3, :3]
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > MAX_DEVIATION:
        raise ValueError(f"its last row is {matrix[3].tolist()}")
    if np.abs(R).max() > 2 or np.abs(R.T @ R - np.eye(3)).max() > MAX_DEVIATION:
        raise ValueError("its columns are not orthonormal")
    if np.linalg.det(R) < 0:
        raise ValueError("it mirrors")
    return Rigid3(nearest_rotation(R) @ CV_FROM_GL, matrix[:3, 3]).inverse()
