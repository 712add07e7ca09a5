"""Masks: which file belongs to which photo, what is kept, what is refused."""

import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

from fieldstone.errors import InputError
from fieldstone.io.images.masks import check_polarity, find_masks, inside_opaque, on_mean_colour, read_mask
from fieldstone.io.images.photos import read_photo, read_photo_info, write_photo


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photos" / "a.jpg"
    write_photo(path, np.full((6, 8, 3), 100, dtype=np.uint8))
    return path


def named(*photos: Path) -> dict[str, Path]:
    return {photo.name: photo for photo in photos}


def write_mask(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(values, dtype=np.uint8)).save(path)


@pytest.mark.parametrize("name", ["a.jpg.png", "a.jpg", "a.png"])
def test_the_usual_names_are_found(tmp_path, photo, name):
    write_mask(tmp_path / "masks" / name, np.full((6, 8), 255))
    write_mask(tmp_path / "masks" / "b.png", np.zeros((3, 3)))
    assert find_masks(tmp_path / "masks", named(photo)) == {photo: tmp_path / "masks" / name}


def test_photos_of_one_name_in_two_folders_have_masks_of_their_own(tmp_path):
    photos = {f"{side}/a.jpg": tmp_path / "photos" / side / "a.jpg" for side in ("left", "right")}
    for name, path in photos.items():
        path.parent.mkdir(parents=True)
        write_photo(path, np.zeros((6, 8, 3), dtype=np.uint8))
        write_mask(tmp_path / "masks" / f"{name}.png", np.full((6, 8), 255))
    found = find_masks(tmp_path / "masks", photos)
    assert found == {path: tmp_path / "masks" / f"{name}.png" for name, path in photos.items()}
    write_mask(tmp_path / "flat" / "a.jpg.png", np.full((6, 8), 255))
    with pytest.raises(InputError, match="no mask for any"):  # whose would it be?
        find_masks(tmp_path / "flat", photos)
    left = {"left/a.jpg": photos["left/a.jpg"]}
    assert find_masks(tmp_path / "flat", left) == {photos["left/a.jpg"]: tmp_path / "flat" / "a.jpg.png"}


def test_white_is_kept_whatever_the_grey_levels(tmp_path, photo):
    keep = np.zeros((6, 8), dtype=bool)
    keep[1:4, 2:7] = True
    info = read_photo_info(photo)
    for white, black in ((255, 0), (1, 0), (250, 6)):
        write_mask(tmp_path / "m.png", np.where(keep, white, black))
        np.testing.assert_array_equal(read_mask(tmp_path / "m.png", info), keep)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mask_in_stored_pixels_turns_with_its_photo(tmp_path, orientation):
    grey = np.zeros((6, 8), dtype=np.uint8)
    grey[:3, :5] = 255
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    Image.fromarray(np.dstack([grey] * 3)).save(tmp_path / "a.png", exif=exif)
    photo = read_photo(tmp_path / "a.png")
    upright = photo.rgb[:, :, 0] > 0
    write_mask(tmp_path / "upright.png", upright * 255)
    np.testing.assert_array_equal(read_mask(tmp_path / "upright.png", photo.info), upright)
    write_mask(tmp_path / "stored.png", grey)
    if orientation >= 5:
        np.testing.assert_array_equal(read_mask(tmp_path / "stored.png", photo.info), upright)


def test_wrong_sizes_are_one_error(tmp_path, photo):
    other = photo.with_name("b.jpg")
    write_photo(other, np.zeros((6, 8, 3), dtype=np.uint8))
    for name in ("a.png", "b.png"):
        write_mask(tmp_path / "masks" / name, np.zeros((8, 6)))
    with pytest.raises(InputError, match=r"a.png: 6 x 8 for a photo of 8 x 6, and 1 more like it"):
        find_masks(tmp_path / "masks", named(photo, other))
    with pytest.raises(InputError, match="another size"):
        read_mask(tmp_path / "masks" / "a.png", read_photo_info(photo))


def test_missing_masks(tmp_path, photo, caplog):
    with pytest.raises(InputError, match="no such folder"):
        find_masks(tmp_path / "masks", named(photo))
    (tmp_path / "masks").mkdir()
    with pytest.raises(InputError, match=r"looked for as a.jpg.png, a.jpg or a.png"):
        find_masks(tmp_path / "masks", named(photo))
    write_mask(tmp_path / "masks" / "a.png", np.zeros((6, 8)))
    with caplog.at_level(logging.WARNING):
        assert list(find_masks(tmp_path / "masks", named(photo, photo.with_name("b.jpg")))) == [photo]
    assert "1 of 2 photos have no mask" in caplog.text


def test_masks_that_keep_next_to_nothing_are_suspicious(caplog):
    with caplog.at_level(logging.WARNING):
        check_polarity([])
        check_polarity([0.0, 0.06, 0.5])
        assert not caplog.records
        check_polarity([0.02, 0.03, 0.5])
    assert "wrong way round" in caplog.text
    with pytest.raises(InputError, match="invert"):
        check_polarity([0.0, 0.0])


def with_alpha(path, alpha, colours=90):
    pixels = np.full((*alpha.shape, 4), colours, dtype=np.uint8)
    pixels[..., 3] = alpha
    pixels[alpha == 0, :3] = 7  # what is stored where nothing is shown
    Image.fromarray(pixels).save(path, lossless=True)
    return read_photo(path)


@pytest.mark.parametrize("suffix", ["png", "webp", "tif"])
def test_alpha_keeps_what_is_opaque_and_off_the_silhouette(tmp_path, suffix):
    alpha = np.zeros((60, 80), dtype=np.uint8)
    alpha[10:50, 20:70] = 255
    alpha[10:50, 70] = 128  # a mixed edge
    photo = with_alpha(tmp_path / f"a.{suffix}", alpha)
    kept = inside_opaque(photo)
    assert kept is not None
    expected = np.zeros_like(kept)
    expected[12:48, 22:68] = True  # two pixels off the outline
    np.testing.assert_array_equal(kept, expected)
    assert (on_mean_colour(photo) == 90).all()


def test_opaque_photos_keep_everything(tmp_path, photo):
    assert inside_opaque(read_photo(photo)) is None
    assert inside_opaque(with_alpha(tmp_path / "a.png", np.full((6, 8), 255, dtype=np.uint8))) is None


def test_a_photo_without_an_opaque_pixel_is_refused(tmp_path):
    with pytest.raises(InputError, match="no pixel opaque"):
        inside_opaque(with_alpha(tmp_path / "a.png", np.full((6, 8), 100, dtype=np.uint8)))
