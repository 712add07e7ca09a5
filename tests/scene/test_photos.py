"""The table of posed photos: cameras by index, whatever is selected."""

from pathlib import Path

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry import rotation
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.photos import DecodedPhotos, PosedPhotos, posed_photos, shared_cameras


def camera(focal, width=6, height=4):
    return Camera("SIMPLE_PINHOLE", width, height, np.array([focal, width / 2, height / 2]))


def poses(n):
    rng = np.random.default_rng(0)
    return Rigid3(rotation.exp(rng.standard_normal((n, 3))), rng.standard_normal((n, 3)))


def table(focals):
    cameras, index = shared_cameras([camera(f) for f in focals])
    names = [f"{i}.png" for i in range(len(focals))]
    masks = [Path(f"m{i}") if i % 2 else None for i in range(len(focals))]
    return posed_photos(names, cameras, index, poses(len(focals)), paths=[Path(name) for name in names], masks=masks)


def test_equal_cameras_are_one_camera_in_the_order_of_first_appearance():
    cameras, index = shared_cameras([camera(f) for f in (5.0, 3.0, 5.0, 4.0, 3.0)])
    assert [c.params[0] for c in cameras] == [5.0, 3.0, 4.0]
    assert index.tolist() == [0, 1, 0, 2, 1]
    other = [camera(5.0), camera(5.0, width=8), Camera("RADIAL", 6, 4, np.array([5.0, 3, 2, 0, 0]))]
    assert len(shared_cameras(other)[0]) == 3


@pytest.mark.parametrize("rows", [[4, 1, 3], [2, 0], [], [3]])
def test_selected_photos_keep_all_that_belongs_to_them(rows):
    focals = (5.0, 3.0, 5.0, 4.0, 3.0)
    whole = table(focals)
    part = whole.select(rows)
    assert part.names == tuple(f"{i}.png" for i in rows)
    assert part.paths == tuple(Path(f"{i}.png") for i in rows)
    assert part.masks == tuple(Path(f"m{i}") if i % 2 else None for i in rows)
    assert [part.camera_of(k).params[0] for k in range(len(part))] == [focals[i] for i in rows]
    # By first use, and none without a photo.
    assert [c.params[0] for c in part.cameras] == list(dict.fromkeys(focals[i] for i in rows))
    for k, i in enumerate(rows):
        np.testing.assert_array_equal(part.pose_of(k).matrix(), whole.pose_of(i).matrix())
        np.testing.assert_array_equal(part.centers()[k], whole.pose_of(i).target_origin_in_source())


def test_photos_of_cameras_are_a_partition():
    focals = (5.0, 3.0, 5.0, 4.0, 3.0)
    groups = table(focals).photos_of_cameras()
    assert [group.tolist() for group in groups] == [[0, 2], [1, 4], [3]]


def test_cameras_that_no_photo_uses_are_left_out():
    cameras = [camera(f) for f in (1.0, 2.0, 3.0)]
    found = posed_photos(["a", "b"], cameras, np.array([2, 0]), poses(2))
    assert [c.params[0] for c in found.cameras] == [3.0, 1.0]
    assert found.camera_of_photo.tolist() == [0, 1]


def test_tables_that_do_not_hold_together_are_refused():
    with pytest.raises(ValueError, match="length"):
        PosedPhotos(("a", "b"), (camera(1.0),), np.zeros(2, dtype=np.int64), poses(3))
    with pytest.raises(ValueError, match="first use"):
        PosedPhotos(("a",), (camera(1.0), camera(2.0)), np.array([1]), poses(1))
    with pytest.raises(ValueError, match="first use"):
        PosedPhotos(("a",), (), np.array([0]), poses(1))


def test_pixels_must_fit_the_cameras():
    posed = table([5.0])
    pixels = np.zeros((4, 6, 3), dtype=np.uint8)
    DecodedPhotos(posed, (pixels,), (np.ones((4, 6), dtype=bool),))
    with pytest.raises(InputError, match="6x3"):
        DecodedPhotos(posed, (pixels[:3],), (None,))
    with pytest.raises(InputError, match="channels"):
        DecodedPhotos(posed, (pixels[..., :2],), (None,))
    with pytest.raises(InputError, match="mask has 5x4"):
        DecodedPhotos(posed, (pixels,), (np.ones((4, 5), dtype=bool),))
    with pytest.raises(ValueError, match="pixels of 0"):
        DecodedPhotos(posed, (), ())


def test_compositing_on_a_background():
    pixels = np.array([[[255, 0, 0, 0], [0, 0, 255, 255], [255, 0, 0, 51]]], dtype=np.uint8)
    photos = DecodedPhotos(table([5.0]).select([]), (), ())
    assert photos.have_alpha, "of no photo, all"
    cameras, index = shared_cameras([camera(1.0, 3, 1)])
    photos = DecodedPhotos(posed_photos(["a"], cameras, index, poses(1)), (pixels,), (None,))
    np.testing.assert_allclose(photos.composited(0, np.ones(3)), [[[1, 1, 1], [0, 0, 1], [1, 0.8, 0.8]]], rtol=1e-6)
