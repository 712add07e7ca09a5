"""From scene files to what a field learns from: frames, splits, and the range of the rays."""

import json

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.field.base.ray_dataset import NORMALIZED_RADIUS
from fieldstone.geometry.rigid3 import look_at
from fieldstone.io.images.photos import write_photo
from fieldstone.io.posed.open import open_posed_scene
from fieldstone.io.shapes.ply import write_points
from fieldstone.run.field_input import frame_of, read_ray_dataset
from fieldstone.scene.reconstruction import Points
from grid_scenes import ball_photos


def write_transforms(folder, *, alpha, **top):
    """The ball, radius 0.8 at the origin, photographed from around."""
    frames = []
    photos = ball_photos(9)
    for v, (name, pixels) in enumerate(zip(photos.posed.names, photos.pixels, strict=True)):
        write_photo(folder / f"{name}.png", pixels if alpha else pixels[..., :3])
        matrix = photos.posed.pose_of(v).inverse().matrix() @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{name}.png", "transform_matrix": matrix.tolist()})
    camera = photos.posed.camera_of(0)
    content = {"fl_x": camera.focal[0], "w": camera.width, "h": camera.height, **top, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("as_file", [False, True])
def test_every_eighth_photo_of_a_file_without_split_is_held_out(tmp_path, as_file):
    folder = write_transforms(tmp_path, alpha=True)
    dataset = read_ray_dataset(folder / "transforms.json" if as_file else folder, None, 100)
    assert list(dataset.test.posed.names) == ["r_0.png", "r_8.png"]
    assert list(dataset.train.posed.names) == [f"r_{k}.png" for k in range(1, 8)]


@pytest.mark.parametrize(
    ("names", "tested"), [((), []), (("r_3.png",), [3]), (("r_3", "r_8.png"), [8, 3]), (("r_0", "r_8"), [0, 8])]
)
def test_other_photos_are_held_out_on_request(tmp_path, names, tested):
    dataset = read_ray_dataset(write_transforms(tmp_path, alpha=True), None, 100, hold_out=names)
    assert sorted(dataset.test.posed.names) == sorted(f"r_{k}.png" for k in tested)
    assert set(dataset.train.posed.names) == {f"r_{k}.png" for k in range(9) if k not in tested}


def test_a_photo_to_hold_out_that_is_not_there_is_named(tmp_path):
    folder = write_transforms(tmp_path, alpha=True)
    with pytest.raises(InputError, match=r"`hold_out` r_9.*r_1\.png"):
        read_ray_dataset(folder, None, 100, hold_out=("r_3", "r_9"))
    with pytest.raises(InputError, match="held out"):
        read_ray_dataset(folder, None, 100, hold_out=tuple(f"r_{k}" for k in range(9)))


def test_photos_with_alpha_show_an_object_in_a_box(tmp_path):
    dataset = read_ray_dataset(write_transforms(tmp_path, alpha=True), None, 100)
    assert dataset.bounded
    np.testing.assert_array_equal(dataset.frame.background, 1.0)
    world = dataset.frame.normalized_from_world
    # The axes of the cameras meet in the middle of the ball, and the ball fits into the box.
    np.testing.assert_allclose(world.apply(np.zeros((1, 3))), 0, atol=0.02)
    assert 0.8 * world.scale < NORMALIZED_RADIUS


def test_photos_without_alpha_show_a_scene_without_bounds(tmp_path):
    dataset = read_ray_dataset(write_transforms(tmp_path, alpha=False), None, 100)
    assert not dataset.bounded
    mean = np.mean([pixels.reshape(-1, 3).mean(axis=0) for pixels in dataset.train.pixels], axis=0) / 255
    np.testing.assert_allclose(dataset.frame.background, mean)
    # The ball is inside of the box, and the cameras are outside.
    assert 0.8 * dataset.frame.normalized_from_world.scale < NORMALIZED_RADIUS
    assert 3.2 * dataset.frame.normalized_from_world.scale > NORMALIZED_RADIUS


def test_a_stated_box_is_the_box(tmp_path):
    folder = write_transforms(tmp_path, alpha=False, aabb_scale=1, scale=0.25, offset=[0.5, 0.5, 0.0])
    dataset = read_ray_dataset(folder, None, 100)
    assert dataset.bounded
    # The unit cube of the file is [-2, 2] x [-2, 2] x [0, 4] in the world.
    corners = dataset.frame.normalized_from_world.apply(np.array([[-2.0, -2, 0], [2, 2, 4]]))
    np.testing.assert_allclose(corners, [[-NORMALIZED_RADIUS] * 3, [NORMALIZED_RADIUS] * 3])
    assert dataset.frame.far > 0


def test_points_of_a_file_give_the_range(tmp_path):
    points = np.random.default_rng(0).normal(size=(300, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    folder = write_transforms(tmp_path, alpha=False, ply_file_path="points.ply")
    write_points(Points(points, np.zeros((300, 3), dtype=np.uint8)), folder / "points.ply")
    found = frame_of(open_posed_scene(folder), np.zeros(3))
    assert found is not None
    frame, bounded = found
    assert not bounded
    scale = frame.normalized_from_world.scale
    assert scale == pytest.approx(NORMALIZED_RADIUS / 0.8, rel=0.1)
    # Cameras stand 3.2 to 3.6 away from the middle.
    assert (3.2 - 0.8) * 0.75 < frame.near / scale < 3.2 - 0.8
    assert 3.2 + 0.5 < frame.far / scale < (3.6 + 0.8) * 1.3


def test_llff_scenes_look_ahead(tmp_path):
    rows = []
    for k in range(10):
        pose = look_at(np.array([0.1 * k, 0.05 * k, 0.0]), np.array([0.4, 0.2, 5]), np.array([0.0, -1, 0]))
        R, t = pose.inverse().R, pose.inverse().t
        matrix = np.column_stack([R[:, 1], R[:, 0], -R[:, 2], t, [30.0, 40.0, 35.0]])
        rows.append(np.concatenate([matrix.reshape(-1), [2.0, 10.0]]))
        write_photo(tmp_path / "images" / f"p{k}.png", np.full((30, 40, 3), 20 * k, dtype=np.uint8))
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    dataset = read_ray_dataset(tmp_path, None, 100)
    assert list(dataset.test.posed.names) == ["p0.png", "p8.png"]
    assert not dataset.bounded
    scale = dataset.frame.normalized_from_world.scale
    assert dataset.frame.near / scale == pytest.approx(0.8 * 2.0, rel=0.2)
    assert dataset.frame.far / scale > 10.0


def test_other_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"transforms\.json"):
        open_posed_scene(tmp_path)
    with pytest.raises(InputError, match="no such"):
        open_posed_scene(tmp_path / "nowhere")


def test_a_photo_that_cannot_be_read_is_left_out(tmp_path, caplog):
    folder = write_transforms(tmp_path, alpha=True)
    data = (folder / "r_3.png").read_bytes()
    (folder / "r_3.png").write_bytes(data[: len(data) // 2])
    names = read_ray_dataset(folder, None, 100).train.posed.names
    assert "r_3.png" not in names
    assert len(names) == 6
    assert "r_3.png" in caplog.text
