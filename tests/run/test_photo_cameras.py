from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera, image_from_plane
from fieldstone.io.images.exif import ExifFacts
from fieldstone.io.images.photos import PhotoInfo, turned_upright
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photo_cameras import cameras_of_photos

STORED = Camera("OPENCV", 640, 480, np.array([500.0, 510, 322, 236, 0.1, -0.02, 0.003, -0.002]))


def info_of(orientation: int, name: str = "a.jpg") -> PhotoInfo:
    size = (480, 640) if orientation >= 5 else (640, 480)
    return PhotoInfo(Path(name), *size, orientation, ExifFacts())


def given(infos, **options):
    intrinsics = tuple(STORED.params.tolist())
    return cameras_of_photos(infos, MatchingOptions(camera_model="OPENCV", intrinsics=intrinsics, **options))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_given_intrinsics_speak_of_stored_pixels(orientation):
    """What falls on a pixel of the stored photo falls on where turning the photo puts this pixel."""
    (camera,) = given([info_of(orientation)]).cameras
    # Photos that show how far right and how far down one is in the stored one.
    row, column = np.mgrid[0:480, 0:640]
    shown = [(column // 3).astype(np.uint8), (row // 2).astype(np.uint8)]
    assert turned_upright(shown[0], orientation).shape == (camera.height, camera.width)
    corner = turned_upright(np.array([[0, 1], [2, 3]], dtype=np.uint8), orientation)
    origin, right, down = (np.argwhere(corner == value)[0, ::-1] for value in (0, 1, 2))
    turn = np.stack([right - origin, down - origin], axis=1)
    uv = np.random.default_rng(0).uniform([-0.5, -0.4], [0.5, 0.4], size=(200, 2))
    x, y = np.floor(image_from_plane(STORED, uv)).astype(int).T
    upright_x, upright_y = np.floor(image_from_plane(camera, uv @ turn.T)).astype(int).T
    for photo in shown:
        np.testing.assert_array_equal(turned_upright(photo, orientation)[upright_y, upright_x], photo[y, x])


def test_photos_share_a_camera_unless_it_was_turned():
    infos = [info_of(1, "a.jpg"), info_of(1, "b.jpg"), info_of(3, "c.jpg"), info_of(6, "d.jpg")]
    for sharing in ("auto", "one", "per-folder"):
        found = given(infos, cameras=sharing)
        assert found.camera_of_image.tolist() == [0, 0, 1, 2]
        assert found.source == ("given",) * 3
        assert found.cameras[1].principal_point.tolist() == [640 - 322, 480 - 236]
        assert found.cameras[2].focal.tolist() == [510, 500]


def photo(name: str, camera: str | None = None, mm: float | None = None, focal_px: float | None = None) -> PhotoInfo:
    lens = None if mm is None else ("", mm, 1.0)
    return PhotoInfo(Path(name), 640, 480, 1, ExifFacts(focal_px, camera, lens))


@pytest.mark.parametrize(
    ("sharing", "groups"),
    [("auto", [0, 0, 1, 2, 3, 3]), ("one", [0] * 6), ("per-folder", [0, 0, 0, 1, 1, 1]), ("per-photo", list(range(6)))],
)
def test_who_shares_a_camera_can_be_said_by_hand(sharing, groups):
    infos = [
        photo("x/1.jpg", "A", 24.0, 500.0),
        photo("x/2.jpg", "A", 24.0, 500.0),
        photo("x/3.jpg", "A", 50.0, 1000.0),  # the same zoom lens, another setting
        photo("y/1.jpg", "B", 50.0, 1000.0),
        photo("y/2.jpg"),
        photo("y/3.jpg"),
    ]
    assert cameras_of_photos(infos, MatchingOptions(cameras=sharing)).camera_of_image.tolist() == groups


def test_photos_without_exif_are_alone_in_the_company_of_many_cameras():
    strangers = [photo(f"{k}.jpg", f"body {k}", 5.0) for k in range(6)]
    unknown = [photo("a.jpg"), photo("b.jpg")]
    found = cameras_of_photos([*strangers, *unknown], MatchingOptions())
    assert found.camera_of_image.tolist() == list(range(8))
    friends = [photo(f"{k}.jpg", "one body", 5.0) for k in range(6)]
    assert cameras_of_photos([*friends, *unknown], MatchingOptions()).camera_of_image.tolist() == [0] * 6 + [1, 1]


def test_intrinsics_that_do_not_fit_the_model_are_refused():
    options = replace(MatchingOptions(), camera_model="OPENCV", intrinsics=(1.0, 2.0, 3.0))
    with pytest.raises(InputError, match=r"`intrinsics` 1\.0,2\.0,3\.0"):
        cameras_of_photos([info_of(1)], options)
