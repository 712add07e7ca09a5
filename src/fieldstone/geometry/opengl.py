"""Camera axes of OpenGL, Blender and BAL: x right, y up, looking along -z. Ours: x right, y down, z forward."""

from __future__ import annotations

import numpy as np

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation

CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
"""Our axes from those of OpenGL, and the other way round."""

MAX_DEVIATION = 1e-3
"""Of R^T R from the identity; files hold float32, which is far better."""


def cam_from_world_of_gl(world_from_gl_cam: np.ndarray) -> Rigid3:
    """`cam_from_world` with our axes of a 4x4 matrix world_from_camera with those of OpenGL.

    Raises:
        ValueError: Not a finite rigid motion; the message says what is wrong.
    """
    matrix = world_from_gl_cam
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
