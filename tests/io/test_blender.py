"""Blender scenes: written from known poses and read back; projection against the format's own definition; damage."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import write_photo
from fieldstone.io.posed.blender import is_blender_folder, read_blender
from fieldstone.synthetic.scenes import SceneOptions, synthesize
from matchers import assert_rigid3_near
from mutations import check_mutations
from real_data import data_folder

ANGLE_X = 0.7
WIDTH, HEIGHT = 40, 30


def make_poses(count: int, seed: int) -> list[Rigid3]:
    truth = synthesize(SceneOptions(num_cameras=count, num_points=5), np.random.default_rng(seed)).truth
    return [truth.pose_of(i) for i in range(count)]


def write_scene(folder: Path, counts: dict[str, int]) -> dict[str, list[Rigid3]]:
    poses = {split: make_poses(n, k) for k, (split, n) in enumerate(counts.items())}
    for split, views in poses.items():
        frames = []
        (folder / split).mkdir(parents=True, exist_ok=True)
        for i, pose in enumerate(views):
            matrix = pose.inverse().matrix() @ np.diag([1, -1, -1, 1])
            frames.append({"file_path": f"./{split}/r_{i}", "rotation": 0.1, "transform_matrix": matrix.tolist()})
            rgba = np.full((HEIGHT, WIDTH, 4), 10 * i, dtype=np.uint8)
            write_photo(folder / split / f"r_{i}.png", rgba)
        text = json.dumps({"camera_angle_x": ANGLE_X, "frames": frames}, indent=1)
        (folder / f"transforms_{split}.json").write_text(text)
    return poses


def test_a_written_scene_is_read_back(tmp_path):
    poses = write_scene(tmp_path, {"train": 3, "val": 2, "test": 2})
    assert is_blender_folder(tmp_path)
    scene = read_blender(tmp_path)
    assert scene.problems == ()
    assert scene.depth_range == (2.0, 6.0)
    assert len(scene.photos.cameras) == 1
    for split, expected in poses.items():
        photos = scene.photos.select(scene.splits[split])
        assert photos.names == tuple(f"r_{i}" for i in range(len(expected)))
        assert photos.paths == tuple(tmp_path / split / f"r_{i}.png" for i in range(len(expected)))
        for i, pose in enumerate(expected):
            assert_rigid3_near(photos.pose_of(i), pose, angle=1e-12, distance=1e-12)
    np.testing.assert_array_equal(scene.held_out(), scene.splits["test"])


def test_without_test_photos_those_of_validation_are_held_out(tmp_path):
    write_scene(tmp_path, {"train": 3, "val": 2})
    scene = read_blender(tmp_path)
    np.testing.assert_array_equal(scene.held_out(), [3, 4])


def test_projection_follows_the_definition_of_the_format(tmp_path):
    """A pixel is where Blender's camera, looking along -z with y up, sees the point: no matrix of ours is used."""
    write_scene(tmp_path, {"train": 2})
    scene = read_blender(tmp_path)
    matrix = np.array(json.loads((tmp_path / "transforms_train.json").read_text())["frames"][1]["transform_matrix"])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, size=(20, 3))
    right, up, backward = (np.sum((points - matrix[:3, 3]) * matrix[:3, k], axis=1) for k in range(3))
    half_width = np.tan(ANGLE_X / 2) * -backward
    expected = np.stack([(right / half_width + 1) * WIDTH / 2, HEIGHT / 2 - up / half_width * WIDTH / 2], axis=1)
    in_cam = scene.photos.pose_of(1).apply(points)
    np.testing.assert_allclose(image_from_cam(scene.photos.camera_of(1), in_cam), expected, rtol=1e-9)


def test_some_missing_images_are_reported_and_skipped(tmp_path, caplog):
    write_scene(tmp_path, {"train": 3, "test": 2})
    (tmp_path / "train" / "r_1.png").unlink()
    (tmp_path / "test" / "r_0.png").write_bytes(b"no image")
    scene = read_blender(tmp_path)
    assert scene.photos.select(scene.splits["train"]).names == ("r_0", "r_2")
    assert scene.photos.select(scene.splits["test"]).names == ("r_1",)
    assert [problem.path.name for problem in scene.problems] == ["r_1.png", "r_0.png"]
    assert "1 of 3 images are missing" in caplog.text


def test_no_training_image_at_all_is_an_error(tmp_path):
    write_scene(tmp_path, {"train": 2, "test": 2})
    for path in (tmp_path / "train").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"transforms_train.json: none of its 2 images is there .*r_0.png"):
        read_blender(tmp_path)


def edit_frame(folder: Path, change) -> None:
    path = folder / "transforms_train.json"
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def set_entry(row: int, column: int, number: float):
    return lambda v: v["frames"][1]["transform_matrix"][row].__setitem__(column, number)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_entry(0, 3, float("nan")), r"frame 1 \(train/r_1\): transform_matrix is no camera pose: it is not finite"),
        (set_entry(0, 0, 5.0), r"frame 1 \(train/r_1\): .* not orthonormal"),
        (set_entry(0, 0, 1e300), r"frame 1 \(train/r_1\): .* not orthonormal"),
        (set_entry(3, 3, 2.0), r"frame 1 \(train/r_1\): .* last row"),
        (lambda v: v["frames"][1].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "it mirrors"),
        (lambda v: v["frames"][1].update(transform_matrix=[[1, 2], [3]]), "no matrix of numbers"),
        (lambda v: v["frames"][1].update(transform_matrix=[1, 2]), "must be 4x4"),
        (lambda v: v["frames"][1].pop("transform_matrix"), "must be 4x4|no matrix"),
        (lambda v: v["frames"][1].pop("file_path"), "frame 1: no file_path"),
        (lambda v: v["frames"][1].update(file_path="../../secret"), "leads out of the photo folder"),
        (lambda v: v["frames"][1].update(file_path="/etc/x"), "leads out of the photo folder"),
        (lambda v: v["frames"][1].update(file_path="train/r_0"), "frames 0 and 1 are both named r_0"),
        (lambda v: v["frames"].append(3), "frame 2: no file_path"),
        (lambda v: v.pop("frames"), "no list `frames`"),
        (lambda v: v.update(camera_angle_x=0), "camera_angle_x must be"),
        (lambda v: v.update(camera_angle_x="0.7"), "camera_angle_x must be"),
        (lambda v: v.update(camera_angle_x=float("nan")), "camera_angle_x must be"),
        (lambda v: v.update(camera_angle_x=0.8), "camera_angle_x is .* use one camera"),
        (lambda v: v.update(frames=[]), "none of its 0 images"),
    ],
)
def test_wrong_files_name_the_frame_and_the_reason(tmp_path, change, message):
    write_scene(tmp_path, {"train": 2, "test": 2})
    edit_frame(tmp_path, change)
    with pytest.raises(InputError, match=message) as caught:
        read_blender(tmp_path)
    assert "transforms_" in str(caught.value)


def test_folders_that_cannot_be_used_say_why(tmp_path):
    with pytest.raises(InputError, match=r"transforms_train.json: no such file"):
        read_blender(tmp_path)
    write_scene(tmp_path, {"train": 2})
    write_photo(tmp_path / "train" / "r_1.png", np.zeros((5, 6, 3), dtype=np.uint8))
    with pytest.raises(InputError, match=r"r_1.png: 6 x 5 pixels, but r_0.png has 40 x 30"):
        read_blender(tmp_path)
    (tmp_path / "transforms_train.json").write_text('{\n"frames": [\n')
    with pytest.raises(InputError, match=r"transforms_train.json, line 3: not valid JSON"):
        read_blender(tmp_path)
    (tmp_path / "transforms_train.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="not valid JSON"):
        read_blender(tmp_path)


def test_damaged_files_end_in_an_input_error_or_a_sound_scene(tmp_path):
    write_scene(tmp_path, {"train": 2})

    def check(scene):
        for R in scene.photos.cam_from_world.R:
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)

    loaded, refused = check_mutations(
        tmp_path / "transforms_train.json", lambda: read_blender(tmp_path), check, count=400
    )
    assert min(loaded, refused) > 10


def test_real_scene_has_its_known_cameras():
    scene = read_blender(data_folder("lego_100"))
    assert {split: len(frames) for split, frames in scene.splits.items()} == {"train": 100, "val": 100, "test": 200}
    np.testing.assert_allclose(scene.photos.cameras[0].params, [0.5 * 100 / np.tan(0.5 * 0.6911112070083618), 50, 50])
    photos = scene.photos.select(scene.splits["train"])
    centers = photos.centers()
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), 4.031, atol=1e-3)
    axes = photos.cam_from_world.R[:, 2]
    # Every camera looks at the origin.
    np.testing.assert_allclose(axes, -centers / np.linalg.norm(centers, axis=1, keepdims=True), atol=1e-5)
