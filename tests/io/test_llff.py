"""LLFF poses: a known point by the format's own definition, the order of photos, and damage."""

from pathlib import Path

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import look_at
from fieldstone.io.images.photos import write_photo
from fieldstone.io.posed.llff import is_llff_folder, read_llff
from real_data import data_folder

POINT = np.array([0.1, 0.2, 4.0])
WIDTH, HEIGHT, FOCAL = 400, 300, 350.0


def write_scene(folder: Path, count: int = 3, copy: str = "images_10") -> np.ndarray:
    rows = []
    for k in range(count):
        pose = look_at(np.array([0.3 * k - 0.3, 0.1 * k, 0.0]), np.array([0.0, 0, 5]), np.array([0.0, -1, 0]))
        R, t = pose.inverse().R, pose.inverse().t
        # Axes of the columns: down, right, back.
        matrix = np.column_stack([R[:, 1], R[:, 0], -R[:, 2], t, [HEIGHT, WIDTH, FOCAL]])
        rows.append(np.concatenate([matrix.reshape(-1), [2.0, 10.0]]))
        write_photo(folder / copy / f"p{k}.png", np.full((HEIGHT // 10, WIDTH // 10, 3), k, dtype=np.uint8))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return np.array(rows)


def test_a_point_falls_where_the_definition_puts_it(tmp_path):
    rows = write_scene(tmp_path)
    assert is_llff_folder(tmp_path)
    scene = read_llff(tmp_path)
    assert not scene.splits
    assert list(scene.photos.names) == ["p0.png", "p1.png", "p2.png"]
    assert len(scene.photos.cameras) == 1
    for v, row in enumerate(rows):
        matrix = row[:15].reshape(3, 5)
        down, right, back = (POINT - matrix[:, 3]) @ matrix[:, :3]
        # The copy has a tenth of the pixels.
        expected = 0.1 * np.array([FOCAL * right / -back + WIDTH / 2, FOCAL * down / -back + HEIGHT / 2])
        in_cam = scene.photos.pose_of(v).apply(POINT[None])
        np.testing.assert_allclose(image_from_cam(scene.photos.camera_of(v), in_cam)[0], expected, rtol=1e-9)


def test_points_lie_at_the_two_depths(tmp_path):
    write_scene(tmp_path)
    scene = read_llff(tmp_path)
    depths = scene.photos.pose_of(0).apply(scene.points_in_world[:10])[:, 2]
    np.testing.assert_allclose(depths, [2.0] * 5 + [10.0] * 5)


def test_the_largest_copy_is_taken_unless_one_is_given(tmp_path):
    write_scene(tmp_path)
    for k in range(3):
        write_photo(tmp_path / "images_5" / f"p{k}.png", np.zeros((60, 80, 3), dtype=np.uint8))
    assert read_llff(tmp_path).photos.camera_of(0).width == 80
    assert read_llff(tmp_path, tmp_path / "images_10").photos.camera_of(0).width == 40


def edited(tmp_path, edit):
    rows = write_scene(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", edit(rows))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda rows: rows[:, :12], "17"),
        (lambda rows: rows[:0], "no pose"),
        (lambda rows: rows[:2], "3 photos, but poses_bounds.npy has 2"),
        (lambda rows: np.where(rows == 10.0, 1.0, rows), "impossible"),
        (lambda rows: np.where(rows == WIDTH, 300, rows), "300x300"),
        (lambda rows: np.where(rows == 2.0, np.nan, rows), "finite"),
        (lambda rows: 2 * rows, "rotation"),
        (lambda rows: np.array(["text"]), "17"),
    ],
)
def test_mistakes_are_named(tmp_path, edit, message):
    edited(tmp_path, edit)
    with pytest.raises(InputError, match=message):
        read_llff(tmp_path)


def test_a_damaged_file_and_missing_photos_are_named(tmp_path):
    write_scene(tmp_path)
    (tmp_path / "poses_bounds.npy").write_bytes(b"\x93NUMPY and no more")
    with pytest.raises(InputError, match="numpy"):
        read_llff(tmp_path)
    write_scene(tmp_path / "b", copy="photos")
    with pytest.raises(InputError, match="images_8"):
        read_llff(tmp_path / "b")


def test_fern_is_read():
    folder = data_folder("llff_fern")
    photos = read_llff(folder).photos
    assert len(photos) == 20
    assert (photos.camera_of(0).width, photos.camera_of(0).height) == (504, 378)
    # The optical axes of photos of one plant point the same way.
    axes = photos.cam_from_world.R[:, 2]
    assert (axes @ axes.mean(axis=0)).min() > 0.9
