import json

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry import rotation
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.posed.camera_path_json import read_camera_path

GL = np.diag([1.0, -1.0, -1.0, 1.0])


def matrices(poses: Rigid3) -> list[np.ndarray]:
    """world_from_camera with OpenGL axes."""
    out = []
    for k in range(len(poses.t)):
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3], cam_from_world[:3, 3] = poses.R[k], poses.t[k]
        out.append(np.linalg.inv(cam_from_world) @ GL)
    return out


@pytest.fixture
def poses() -> Rigid3:
    rng = np.random.default_rng(3)
    return Rigid3.stack([Rigid3(rotation.exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(4)])


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize(("name", "matrix"), [("frames", "transform_matrix"), ("camera_path", "camera_to_world")])
def test_both_layouts_give_the_poses(tmp_path, poses, name, matrix, flat):
    path = tmp_path / "path.json"
    entries = [{matrix: (m.reshape(-1) if flat else m).tolist(), "fov": 50} for m in matrices(poses)]
    path.write_text(json.dumps({name: entries, "fps": 24}))
    found = read_camera_path(path)
    np.testing.assert_allclose(found.R, poses.R, atol=1e-12)
    np.testing.assert_allclose(found.t, poses.t, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[1, 2", "not valid JSON"),
        ("[]", "no poses"),
        ('{"frames": []}', "no poses"),
        ('{"frames": [{"file_path": "a"}]}', r"frames\[0\] has no transform_matrix"),
        ('{"frames": [7]}', r"frames\[0\] has no transform_matrix"),
        ('{"camera_path": [{"camera_to_world": [1, 2, 3]}]}', r"camera_path\[0\].camera_to_world is no camera pose"),
        ('{"camera_path": [{"camera_to_world": "up"}]}', "is no matrix of numbers"),
        (json.dumps({"frames": [{"transform_matrix": (2 * np.eye(4)).tolist()}]}), "is no camera pose"),
        (json.dumps({"frames": [{"transform_matrix": np.full((4, 4), np.nan).tolist()}]}), "not finite"),
    ],
)
def test_what_is_no_path_is_one_clear_error(tmp_path, content, says):
    path = tmp_path / "path.json"
    path.write_text(content)
    with pytest.raises(InputError, match=says) as caught:
        read_camera_path(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_told_so(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_camera_path(tmp_path / "none.json")
