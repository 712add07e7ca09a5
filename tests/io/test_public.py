"""What `fieldstone.io` offers: every public name once, through the package, with an oracle."""

import inspect
import json
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

import fieldstone.geometry as g
import fieldstone.io as fio
from fieldstone.errors import InputError
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.reconstruction import Points, Reconstruction
from fieldstone.scene.splats import NUM_SH, Splats
from fieldstone.solve import BundleProblem
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize

POSE = g.look_at(np.array([3.0, 0.5, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
WORLD_FROM_GL = POSE.inverse().matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])
"""The camera as most formats write it: looking along -z with y up."""
WIDTH, HEIGHT, FOCAL = 40, 30, 50.0
RGB = np.random.default_rng(0).integers(0, 256, size=(HEIGHT, WIDTH, 3), dtype=np.uint8)


def scene(camera: g.Camera | None = None) -> SyntheticScene:
    camera = camera or g.Camera("PINHOLE", 640, 480, np.array([700.0, 690.0, 330.0, 236.0]))
    options = SceneOptions(num_cameras=4, num_points=30, camera=camera, noise_px=0.5)
    return synthesize(options, np.random.default_rng(0))


def assert_same_model(found: Reconstruction, truth: Reconstruction) -> None:
    for a, b in zip(found.cameras, truth.cameras, strict=True):
        assert (a.model, a.width, a.height, a.params.tolist()) == (b.model, b.width, b.height, b.params.tolist())
    assert [(v.name, v.camera) for v in found.views] == [(v.name, v.camera) for v in truth.views]
    for v in truth.registered().tolist():
        # Files hold rotations as quaternions: the last bits of R differ, and nothing else.
        np.testing.assert_allclose(found.pose_of(v).R, truth.pose_of(v).R, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(found.pose_of(v).t, truth.pose_of(v).t)
    np.testing.assert_array_equal(found.points.xyz, truth.points.xyz)
    np.testing.assert_array_equal(found.points.rgb, truth.points.rgb)
    for name in ("view", "point", "pixels"):
        np.testing.assert_array_equal(getattr(found.observations, name), getattr(truth.observations, name))


def assert_sees_the_pose(found: fio.PosedScene) -> None:
    """One photo, from `POSE`, with the focal length of this file."""
    assert isinstance(found, fio.PosedScene)
    assert len(found.photos.names) >= 1
    np.testing.assert_allclose(found.photos.pose_of(0).matrix(), POSE.matrix(), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.photos.camera_of(0).focal, FOCAL, rtol=1e-12)


def colmap_model(folder: Path) -> None:
    truth = scene().truth
    fio.write_colmap(truth, folder / "sparse" / "0")
    assert fio.find_colmap_model(folder) == folder / "sparse" / "0"
    assert_same_model(fio.read_colmap(folder), truth)


def bal_problem(folder: Path) -> None:
    truth = scene(g.Camera("RADIAL", 640, 480, np.array([500.0, 0.0, 0.0, -0.1, 0.01]))).truth
    observations, num_views = truth.observations, len(truth.views)
    problem = BundleProblem(
        cameras=truth.cameras * num_views,
        camera_of_view=np.arange(num_views),
        cam_from_world=g.Rigid3.stack([truth.pose_of(v) for v in range(num_views)]),
        points=truth.points.xyz,
        view=observations.view,
        point=observations.point,
        pixels=observations.pixels,
        fixed_views=np.zeros(num_views, dtype=bool),
        fixed_points=np.zeros(len(truth.points), dtype=bool),
        refine=(np.ones(5, dtype=bool),) * num_views,
    )
    fio.write_bal(problem, folder / "problem.txt")
    found = fio.read_bal(folder / "problem.txt")
    for name in ("points", "view", "point", "pixels"):
        np.testing.assert_array_equal(getattr(found, name), getattr(problem, name))


def points(folder: Path) -> None:
    rng = np.random.default_rng(0)
    written = Points(rng.normal(size=(9, 3)), rng.integers(0, 256, size=(9, 3), dtype=np.uint8))
    fio.write_points(written, folder / "points.ply")
    found = fio.read_points(folder / "points.ply")
    np.testing.assert_array_equal(found.xyz, written.xyz)
    np.testing.assert_array_equal(found.rgb, written.rgb)


def mesh(folder: Path) -> None:
    written = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], dtype=np.uint8))
    fio.write_mesh(written, folder / "mesh.ply")
    found = fio.read_points(folder / "mesh.ply")
    np.testing.assert_array_equal(found.xyz, written.vertices)
    np.testing.assert_array_equal(found.rgb, written.colors)


def splats(folder: Path) -> None:
    means = np.arange(6.0).reshape(2, 3)
    written = Splats(means, np.stack([np.eye(3)] * 2), np.ones((2, 3)), np.full(2, 0.5), np.zeros((2, NUM_SH, 3)))
    fio.write_splats(written, folder / "splats.ply")
    np.testing.assert_array_equal(fio.read_points(folder / "splats.ply").xyz, means)


def photo(folder: Path) -> None:
    fio.write_photo(folder / "photo.png", RGB)
    found = fio.read_photo(folder / "photo.png")
    assert isinstance(found, fio.Photo)
    np.testing.assert_array_equal(found.rgb, RGB)


def films(folder: Path) -> None:
    frames = [RGB, RGB[::-1].copy()]
    assert fio.write_mp4(folder / "film.mp4", frames) == fio.write_gif(folder / "film.gif", frames) == 2
    with av.open(str(folder / "film.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 2
    with Image.open(folder / "film.gif") as film:
        assert getattr(film, "n_frames", 1) == 2


def transforms(folder: Path) -> None:
    fio.write_photo(folder / "images" / "1.png", RGB)
    frame = {"file_path": "images/1.png", "transform_matrix": WORLD_FROM_GL.tolist()}
    (folder / "transforms.json").write_text(json.dumps({"fl_x": FOCAL, "frames": [frame]}))
    assert_sees_the_pose(fio.read_transforms(folder / "transforms.json"))
    assert_sees_the_pose(fio.open_posed_scene(folder))


def blender(folder: Path) -> None:
    fio.write_photo(folder / "train" / "r_0.png", np.dstack([RGB, RGB[..., :1]]))
    angle = 2 * np.arctan(WIDTH / 2 / FOCAL)
    frame = {"file_path": "./train/r_0", "transform_matrix": WORLD_FROM_GL.tolist()}
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": angle, "frames": [frame]}))
    assert_sees_the_pose(fio.read_blender(folder))
    assert_sees_the_pose(fio.open_posed_scene(folder))


def llff(folder: Path) -> None:
    fio.write_photo(folder / "images" / "1.png", RGB)
    R, t = POSE.inverse().R, POSE.inverse().t
    down_right_back = np.column_stack([R[:, 1], R[:, 0], -R[:, 2], t, [HEIGHT, WIDTH, FOCAL]])
    np.save(folder / "poses_bounds.npy", np.concatenate([down_right_back.reshape(-1), [2.0, 10.0]])[None])
    assert_sees_the_pose(fio.read_llff(folder))
    assert_sees_the_pose(fio.open_posed_scene(folder))


def camera_path(folder: Path) -> None:
    (folder / "path.json").write_text(json.dumps({"camera_path": [{"camera_to_world": WORLD_FROM_GL.tolist()}]}))
    found = fio.read_camera_path(folder / "path.json")
    np.testing.assert_allclose(found[0].matrix(), POSE.matrix(), rtol=0, atol=1e-12)


def given_matches(folder: Path) -> None:
    """The files count pixels from the centre of the first one."""
    assert not fio.is_given_matches_folder(folder)
    (folder / "calibration.txt").write_text("50 0 19.5\n0 50 14.5\n0 0 1\n")
    (folder / "matching1.txt").write_text("nFeatures: 1\n2 10 20 30 4.0 5.0 2 6.0 7.0\n")
    assert fio.is_given_matches_folder(folder)
    given = fio.read_given_matches(folder)
    assert isinstance(given, fio.GivenMatches)
    np.testing.assert_array_equal(given.camera.params, [FOCAL, FOCAL, 20.0, 15.0])
    np.testing.assert_array_equal(np.concatenate(given.graph.keypoints), [[4.5, 5.5], [6.5, 7.5]])
    np.testing.assert_array_equal(given.graph.matches[0, 1], [[0, 0]])


def checkpoint(folder: Path) -> None:
    written = {"a": RGB, "b": np.arange(5) * 0.1}
    fio.write_checkpoint(folder / "c.safetensors", written, {"kind": "test", "number": 0.1})
    tensors, header = fio.read_checkpoint(folder / "c.safetensors")
    assert header == {"kind": "test", "number": 0.1}
    assert tensors.keys() == written.keys()
    for name, tensor in written.items():
        assert tensors[name].dtype == tensor.dtype
        np.testing.assert_array_equal(tensors[name], tensor)


CASES = (
    bal_problem, blender, camera_path, checkpoint, colmap_model, films, given_matches, llff, mesh, photo, points,
    splats, transforms,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_public_function_meets_its_oracle(case, tmp_path):
    case(tmp_path)


@pytest.mark.parametrize("name", [name for name in dir(fio) if name.startswith(("read_", "open_"))])
def test_what_is_not_there_is_an_input_error(name, tmp_path):
    with pytest.raises(InputError, match="none"):
        getattr(fio, name)(tmp_path / "none")


def test_every_public_name_is_tried_here_and_documented():
    source = inspect.getsource(sys.modules[__name__])
    for name in dir(fio):
        assert f"fio.{name}" in source, name
        public = getattr(fio, name)
        assert public.__doc__, name
        assert not public.__doc__.startswith(f"{name}("), f"{name} has no docstring but dataclass's own"


def test_importing_the_package_imports_nothing_slow():
    code = """
import sys, fieldstone.io as package
dir(package)
slow = {"numba", "scipy", "numpy", "cv2", "torch", "av", "PIL", "safetensors"} & set(sys.modules)
assert not slow, slow
package.read_points
assert "numpy" in sys.modules and "av" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_name_that_is_not_public_is_refused():
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        fio.nothing_of_the_kind  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
