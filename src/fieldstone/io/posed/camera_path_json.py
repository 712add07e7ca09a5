"""Camera paths from files: `frames` as in transforms.json, or `camera_path` as nerfstudio's viewer writes it.

Matrices are world_from_camera with OpenGL axes, in the world of the photos. Only poses are taken: what is rendered has
the intrinsics of the photos.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fieldstone.errors import InputError
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.posed.posed_scene import rigid_from_gl

LISTS = {"frames": "transform_matrix", "camera_path": "camera_to_world"}
"""Where the poses stand, and the name of the matrix of each."""

MAX_POSES = 100_000


def read_camera_path(path: Path) -> Rigid3:
    """`cam_from_world` of every camera of a file, in its order.

    Raises:
        InputError: No such file, or it holds no poses; the message names the first wrong one.
    """
    try:
        top = json.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give orbit, spiral, or a JSON file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error}); copy it again") from error
    name = next((name for name in LISTS if isinstance(top, dict) and isinstance(top.get(name), list)), None)
    if name is None or not top[name]:
        raise InputError(f"{path}: no poses; a camera path has a list `frames` or `camera_path` with at least one")
    if len(top[name]) > MAX_POSES:
        raise InputError(f"{path}: {len(top[name])} poses are more than {MAX_POSES}; split the path")
    poses = []
    for k, entry in enumerate(top[name]):
        try:
            matrix = np.array(entry[LISTS[name]], dtype=np.float64)
            poses.append(rigid_from_gl(matrix.reshape(4, 4) if matrix.shape == (16,) else matrix))
        except KeyError as error:
            raise InputError(f"{path}, {name} {k}: no {LISTS[name]}") from error
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{path}, {name} {k}: {LISTS[name]} is no camera pose: {error}") from error
    return Rigid3.stack(poses)
