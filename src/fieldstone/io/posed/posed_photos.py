"""Photos with known cameras, as scene files list them: not yet decoded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation

CV_FROM_GL = np.diag([1.0, -1.0, -1.0])

MAX_DEVIATION = 1e-3
"""Of R^T R from the identity; files hold float32, which is far better."""


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """One photo; photos of one camera share the `Camera` object."""

    name: str
    path: Path
    camera: Camera
    cam_from_world: Rigid3
    mask: Path | None = None
    """Image of the photo's size, black where the photo is to be ignored."""


@dataclass(frozen=True, eq=False)
class PosedScene:
    """What a scene file describes."""

    train: tuple[PosedPhoto, ...]
    test: tuple[PosedPhoto, ...] | None
    """Photos that the file holds out; None if it does not say."""
    points_in_world: Float[np.ndarray, "p 3"]
    """Known points; may be none."""
    box: Float[np.ndarray, "2 3"] | None = None
    """Lower and upper corner of all there is, in the world; None: unknown, or without bounds."""


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
