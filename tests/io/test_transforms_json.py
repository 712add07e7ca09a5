"""nerfstudio and instant-ngp files: a known point through each camera by the format's own definition, and damage."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import look_at
from fieldstone.io.images.photos import write_photo
from fieldstone.io.posed.transforms_json import find_transforms, read_transforms
from fieldstone.io.shapes.ply import write_points
from fieldstone.scene.reconstruction import Points
from mutations import check_mutations

WIDTH, HEIGHT = 40, 30
POINT = np.array([0.3, -0.2, 0.5])


def matrices(count: int) -> list[np.ndarray]:
    """world_from_camera with OpenGL axes, of cameras on a circle."""
    out = []
    for angle in np.linspace(0, 5, count):
        eye = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.0])
        matrix = look_at(eye, np.zeros(3), np.array([0.0, 0, 1])).inverse().matrix() @ np.diag([1, -1, -1, 1])
        out.append(matrix)
    return out


def write_scene(folder: Path, top: dict[str, Any], frames: list[dict[str, Any]] | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for k, matrix in enumerate(matrices(4)):
        entry: dict[str, Any] = {"file_path": f"images/f{k + 8}.png", "transform_matrix": matrix.tolist()}
        entry |= frames[k] if frames else {}
        write_photo(folder / "images" / f"f{k + 8}.png", np.full((HEIGHT, WIDTH, 3), 10 * k, dtype=np.uint8))
        entries.append(entry)
    path = folder / "transforms.json"
    path.write_text(json.dumps({**top, "frames": entries}, indent=1))
    return path


def pixel_by_definition(matrix, fx, fy, cx, cy, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    """The camera looks along -z with y up; OpenCV's distortion; image y runs down."""
    x, y, z = np.linalg.inv(matrix)[:3] @ np.append(POINT, 1.0)
    u, v = x / -z, -y / -z
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    ud = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    vd = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    return np.array([fx * ud + cx, fy * vd + cy])


@pytest.mark.parametrize(
    ("top", "definition"),
    [
        ({"fl_x": 50, "fl_y": 52, "cx": 21, "cy": 14}, (50, 52, 21, 14)),
        (
            {"fl_x": 50, "fl_y": 52, "cx": 21, "cy": 14, "k1": 0.1, "k2": -0.02, "p1": 0.01, "p2": -0.02},
            (50, 52, 21, 14, 0.1, -0.02, 0.01, -0.02),
        ),
        (
            {"fl_x": 50, "fl_y": 52, "cx": 21, "cy": 14, "distortion_params": [0.1, -0.02, 0.03, 0, 0.01, -0.02]},
            (50, 52, 21, 14, 0.1, -0.02, 0.01, -0.02, 0.03),
        ),
        ({"camera_angle_x": 0.7}, (20 / math.tan(0.35), 20 / math.tan(0.35), 20, 15)),
        ({"x_fov": 40.0, "y_fov": 30.0}, (20 / math.tan(math.radians(20)), 15 / math.tan(math.radians(15)), 20, 15)),
        ({"w": 400, "h": 300, "fl_x": 500, "fl_y": 520, "cx": 210, "cy": 140}, (50, 52, 21, 14)),
    ],
)
def test_a_point_falls_where_the_definition_puts_it(tmp_path, top, definition):
    scene = read_transforms(write_scene(tmp_path, top))
    photos = scene.photos
    assert not scene.splits
    # Natural order: f8, f9, f10, f11.
    assert list(photos.names) == [f"images/f{k}.png" for k in (8, 9, 10, 11)]
    assert len(photos.cameras) == 1
    for v, matrix in enumerate(matrices(4)):
        pixel = image_from_cam(photos.cameras[0], photos.pose_of(v).apply(POINT[None]))[0]
        np.testing.assert_allclose(pixel, pixel_by_definition(matrix, *definition), rtol=1e-9)


def test_a_frame_may_have_a_camera_of_its_own(tmp_path):
    frames: list[dict[str, Any]] = [{}, {"fl_x": 60.0, "fl_y": 60.0}, {}, {"k1": 0.1}]
    photos = read_transforms(write_scene(tmp_path, {"fl_x": 50, "fl_y": 50}, frames)).photos
    assert [camera.model for camera in photos.cameras] == ["PINHOLE", "PINHOLE", "OPENCV"]
    assert [camera.params[0] for camera in photos.cameras] == [50, 60, 50]
    assert photos.camera_of_photo.tolist() == [0, 1, 0, 2]


def test_fisheye_coefficients_are_those_of_the_fisheye(tmp_path):
    top = {"camera_model": "OPENCV_FISHEYE", "fl_x": 30, "fl_y": 30, "k1": 0.1, "k2": 0.02, "k3": 0.01, "k4": -0.01}
    scene = read_transforms(write_scene(tmp_path, top))
    x, y, z = np.linalg.inv(matrices(1)[0])[:3] @ np.append(POINT, 1.0)
    u, v = x / -z, -y / -z
    r = np.hypot(u, v)
    angle = np.arctan(r)
    distorted = angle * (1 + 0.1 * angle**2 + 0.02 * angle**4 + 0.01 * angle**6 - 0.01 * angle**8)
    expected = np.array([30 * u * distorted / r + 20, 30 * v * distorted / r + 15])
    camera, pose = scene.photos.camera_of(0), scene.photos.pose_of(0)
    np.testing.assert_allclose(image_from_cam(camera, pose.apply(POINT[None]))[0], expected, rtol=1e-9)


def test_splits_points_and_boxes_are_read(tmp_path):
    top = {
        "fl_x": 50,
        "train_filenames": ["images/f8.png", "images/f10.png"],
        "test_filenames": ["images/f11.png"],
        "val_filenames": ["images/f9.png"],
        "ply_file_path": "points.ply",
        "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
        "aabb_scale": 1,
        "scale": 0.25,
        "offset": [0.5, 0.5, 0.0],
    }
    xyz = np.random.default_rng(0).normal(size=(5, 3))
    write_points(Points(xyz, np.zeros((5, 3), dtype=np.uint8)), tmp_path / "points.ply")
    scene = read_transforms(write_scene(tmp_path, top))
    assert scene.photos.select(scene.splits["train"]).names == ("images/f8.png", "images/f10.png")
    assert scene.photos.select(scene.held_out()).names == ("images/f11.png",)
    np.testing.assert_array_equal(scene.points_in_world, xyz)
    # position * scale + offset lies in the unit cube.
    assert scene.box is not None
    np.testing.assert_allclose(scene.box * 0.25 + [0.5, 0.5, 0.0], [[0, 0, 0], [1, 1, 1]], atol=1e-12)


def test_comments_and_suffixes_left_out_are_understood(tmp_path):
    path = write_scene(tmp_path, {"fl_x": 50})
    path.write_text("// made by hand\n" + path.read_text().replace(".png", ""))
    assert len(read_transforms(path).photos) == 4
    assert find_transforms(tmp_path) == path
    assert find_transforms(path) == path
    assert find_transforms(tmp_path / "images") is None


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda top: top.pop("frames"), "frames"),
        (lambda top: top.pop("fl_x"), "focal"),
        (lambda top: top.update(fl_x=-3), "positive"),
        (lambda top: top.update(fl_x="wide"), "fl_x"),
        (lambda top: top.update(w=30), "30x30|w and h"),
        (lambda top: top.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        (lambda top: top.update(distortion_params=[1, 2]), "six"),
        (lambda top: top["frames"][2].update(transform_matrix=[[math.nan] * 4] * 4), "frame 2 .*finite"),
        (lambda top: top["frames"][2].update(transform_matrix=(2 * np.eye(4)).tolist()), "frame 2 .*row"),
        (lambda top: top["frames"][2].pop("transform_matrix"), "frame 2"),
        (lambda top: top["frames"][1].update(file_path="../secret.png"), "frame 1"),
        (lambda top: top["frames"][1].update(file_path="images/f8.png"), "before"),
        (lambda top: [f.update(file_path="gone.png") for f in top["frames"]], "none of its 4 images"),
        (lambda top: top.update(train_filenames=["nothing.png"]), "train_filenames"),
    ],
)
def test_mistakes_are_named(tmp_path, edit, message):
    path = write_scene(tmp_path, {"fl_x": 50, "h": 30, "w": 40})
    top = json.loads(path.read_text())
    edit(top)
    path.write_text(json.dumps(top))
    with pytest.raises(InputError, match=message):
        read_transforms(path)


def test_random_damage_is_refused_or_understood(tmp_path):
    path = write_scene(tmp_path, {"fl_x": 50, "aabb_scale": 1})

    def check(scene):
        assert len(scene.photos)
        for camera in scene.photos.cameras:
            assert np.isfinite(camera.params).all()

    loaded, refused = check_mutations(path, lambda: read_transforms(path), check, count=150)
    assert loaded
    assert refused
