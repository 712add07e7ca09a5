"""Camera paths from files: `frames` as in transforms.json, or `camera_path` as nerfstudio's viewer writes it.

Matrices are world_from_camera with OpenGL axes, in the world of the photos. Only poses are taken: what is rendered has
the intrinsics of the photos.
"""

from __future__ import annotations

from pathlib import Path

from fieldstone.errors import InputError
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.others import camera_pose, read_json

LISTS = {"frames": "transform_matrix", "camera_path": "camera_to_world"}
"""Where the poses stand, and the name of the matrix of each."""

MAX_POSES = 100_000


def read_camera_path(path: Path) -> Rigid3:
    """`cam_from_world` of every camera of a file, in its order.

    Raises:
        InputError: No such file, or it holds no poses; the message names the first wrong one.
    """
    if not path.is_file():
        raise InputError(f"{path}: cannot be read (no such file); give orbit, spiral, or a JSON file")
    top = read_json(path)
    name = next((name for name in LISTS if isinstance(top, dict) and isinstance(top.get(name), list)), None)
    if name is None or not top[name]:
        raise InputError(f"{path}: no poses; a camera path has a list `frames` or `camera_path` with at least one")
    if len(top[name]) > MAX_POSES:
        raise InputError(f"{path}: {len(top[name])} poses are more than {MAX_POSES}; split the path")
    poses = []
    for k, entry in enumerate(top[name]):
        if not isinstance(entry, dict) or LISTS[name] not in entry:
            raise InputError(f"{path}: {name}[{k}] has no {LISTS[name]}; correct or remove it")
        poses.append(camera_pose(entry[LISTS[name]], f"{path}: {name}[{k}].{LISTS[name]}"))
    return Rigid3.stack(poses)
