"""Photos against arrays of known pixels, EXIF written by Pillow, and damaged files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD
from PIL.TiffImagePlugin import IFDRational

from fieldstone.errors import InputError
from fieldstone.io.images import photos as photos_module
from fieldstone.io.images.photos import (
    list_photos,
    natural_key,
    photo_name,
    read_photo,
    read_photo_info,
    write_photo,
)
from mutations import check_mutations
from real_data import data_folder


def gradient(height: int = 24, width: int = 40) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 6, y * 10, (x + y) * 3], axis=2).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff", ".PNG"])
def test_lossless_formats_return_the_pixels(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_photo(path, gradient())
    photo = read_photo(path)
    np.testing.assert_array_equal(photo.rgb, gradient())
    assert photo.alpha is None
    assert (photo.info.width, photo.info.height) == (40, 24)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_lossy_formats_return_nearly_the_pixels(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_photo(path, gradient())
    assert np.abs(read_photo(path).rgb.astype(int) - gradient()).mean() < 3


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_sixteen_bits_keep_the_upper_eight(tmp_path, suffix, channels):
    wide = np.random.default_rng(0).integers(0, 2**16, size=(9, 7, channels), dtype=np.uint16)
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), wide[:, :, ::-1])
    np.testing.assert_array_equal(read_photo(path).rgb, np.broadcast_to(wide >> 8, (9, 7, 3)).astype(np.uint8))


def test_grey_palette_and_cmyk_become_rgb(tmp_path):
    grey = gradient()[:, :, 0]
    Image.fromarray(grey).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_photo(tmp_path / "grey.png").rgb, np.repeat(grey[:, :, None], 3, axis=2))
    Image.fromarray(gradient()).quantize(200).save(tmp_path / "palette.png")
    assert np.abs(read_photo(tmp_path / "palette.png").rgb.astype(int) - gradient()).mean() < 8
    Image.fromarray(gradient()).convert("CMYK").save(tmp_path / "cmyk.tif")
    np.testing.assert_allclose(read_photo(tmp_path / "cmyk.tif").rgb, gradient(), atol=1)


def test_alpha_is_kept_straight(tmp_path):
    rgba = np.random.default_rng(1).integers(0, 256, size=(5, 6, 4), dtype=np.uint8)
    write_photo(tmp_path / "a.png", rgba)
    photo = read_photo(tmp_path / "a.png")
    np.testing.assert_array_equal(photo.rgb, rgba[:, :, :3])
    np.testing.assert_array_equal(photo.alpha, rgba[:, :, 3])
    np.testing.assert_array_equal(photo.pixels, rgba)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied_once_and_recorded(tmp_path, orientation):
    upright = gradient()
    # EXIF 2.3, tag 274: where row 0 and column 0 of the stored pixels lie in the upright photo.
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: upright.transpose(1, 0, 2)[::-1],
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: upright.transpose(1, 0, 2)[:, ::-1],
    }[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "a.png", exif=exif)
    photo = read_photo(tmp_path / "a.png")
    np.testing.assert_array_equal(photo.rgb, upright)
    assert photo.info.orientation == orientation
    assert (photo.info.width, photo.info.height) == (40, 24)


def save_with_exif(path, **tags):
    exif = Image.Exif()
    names = {
        "f35": 0xA405,
        "focal": 0x920A,
        "resolution": 0xA20E,
        "unit": 0xA210,
        "stored_width": 0xA002,
        "zoom": 0xA404,
    }
    exif.get_ifd(IFD.Exif).update({names[k]: v for k, v in tags.items() if k in names})
    exif.get_ifd(IFD.GPSInfo).update(tags.get("gps", {}))
    exif[0x010F], exif[0x0110] = tags.get("make", "ACME"), "X1\0"
    Image.fromarray(gradient(300, 400)).save(path, exif=exif)
    return read_photo_info(path).exif


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"f35": 28}, 28 / np.hypot(36, 24) * 500),
        ({"focal": IFDRational(5), "resolution": IFDRational(2540), "unit": 2}, 500.0),
        ({"focal": IFDRational(5), "resolution": IFDRational(1000), "unit": 3}, 500.0),
        ({"focal": IFDRational(5), "resolution": IFDRational(1000), "unit": 3, "stored_width": 800}, 250.0),
        ({"focal": IFDRational(5), "resolution": IFDRational(2000), "unit": 3, "stored_width": 400}, None),
        ({"focal": IFDRational(5)}, None),
        ({"focal": IFDRational(50), "resolution": IFDRational(1000), "unit": 3, "stored_width": 400}, None),
        ({"f35": 28, "zoom": IFDRational(18, 10)}, 1.8 * 28 / np.hypot(36, 24) * 500),
        ({"f35": 28, "zoom": IFDRational(0)}, 28 / np.hypot(36, 24) * 500),
        ({"f35": 28, "zoom": IFDRational(1, 0)}, 28 / np.hypot(36, 24) * 500),
        ({"focal": IFDRational(5), "resolution": IFDRational(1000), "unit": 3, "zoom": 2.0}, 1000.0),
        ({"f35": 0, "focal": IFDRational(5), "resolution": IFDRational(100), "unit": 4}, 500.0),
        ({"f35": 9999}, None),
        ({"focal": IFDRational(5, 0), "resolution": IFDRational(1, 0)}, None),
        ({}, None),
    ],
)
def test_focal_prior_in_pixels(tmp_path, tags, expected):
    facts = save_with_exif(tmp_path / "a.jpg", **tags)
    assert facts.focal_px == (None if expected is None else pytest.approx(expected))
    assert facts.camera == "ACME X1"


def test_one_lens_at_two_settings_is_told_apart(tmp_path):
    wide, long, cropped = (
        save_with_exif(tmp_path / "a.jpg", **tags).lens
        for tags in ({"focal": IFDRational(24)}, {"focal": IFDRational(70)}, {"focal": IFDRational(24), "zoom": 2.0})
    )
    assert len({wide, long, cropped}) == 3
    assert save_with_exif(tmp_path / "a.jpg").lens is None


def test_the_equivalent_of_some_makers_counts_digital_zoom(tmp_path):
    counted, not_counted = (
        save_with_exif(tmp_path / "a.jpg", f35=52, zoom=IFDRational(2), make=make).focal_px
        for make in ("Apple", "ACME")
    )
    assert counted is not None
    assert not_counted == pytest.approx(2 * counted)


def test_gps_in_signed_degrees(tmp_path):
    place = {1: "S", 2: (33.0, 30.0, 36.0), 3: "E", 4: (151.0, 15.0, 0.0), 5: b"\x01", 6: 12.5}
    gps = save_with_exif(tmp_path / "a.jpg", gps=place).gps
    assert gps is not None
    assert gps.latitude_deg == pytest.approx(-33.51)
    assert gps.longitude_deg == pytest.approx(151.25)
    assert gps.altitude_m == pytest.approx(-12.5)
    broken = save_with_exif(tmp_path / "b.jpg", gps=place | {2: (IFDRational(1, 0), 0.0, 0.0)})
    assert broken.gps is None


@pytest.mark.parametrize(("suffix", "at_least_px", "width"), [("jpg", 100, 160), ("jpg", 161, 320), ("png", 100, 640)])
def test_a_photo_that_is_shown_small_is_decoded_small(tmp_path, suffix, at_least_px, width):
    """A JPEG at 1/2, 1/4 or 1/8 of its size, and turned all the same; its facts stay those of the whole photo."""
    ramp = np.linspace(0, 255, 640)[None, :, None] * np.ones((480, 1, 3))
    exif = Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(ramp.astype(np.uint8)).save(path, exif=exif)
    photo = read_photo(path, at_least_px=at_least_px)
    assert photo.rgb.shape == (width, 3 * width // 4, 3)
    assert (photo.info.width, photo.info.height) == (480, 640)
    expected = np.asarray(Image.fromarray(read_photo(path).rgb).resize((3 * width // 4, width), Image.Resampling.BOX))
    np.testing.assert_allclose(photo.rgb.astype(float), expected, atol=4)


def test_photos_are_listed_in_natural_order(tmp_path):
    for name in ["img10.png", "img2.png", "IMG1.JPG", "._img3.png", "notes.txt", "img2b.png"]:
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    assert [p.name for p in list_photos(tmp_path)] == ["IMG1.JPG", "img2.png", "img2b.png", "img10.png"]
    assert natural_key("a²") < natural_key("b")


def test_photos_of_several_folders_are_listed_folder_by_folder(tmp_path):
    for name in ("p10/a.jpg", "p2/b.jpg", "p2/a.jpg", "p2/thumbs/a.jpg", ".trash/c.jpg", "p2/.d.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    names = [photo_name(path, tmp_path) for path in list_photos(tmp_path)]
    assert names == ["p2/a.jpg", "p2/b.jpg", "p10/a.jpg"]
    (tmp_path / "own.jpg").write_bytes(b"")
    assert [photo_name(path, tmp_path) for path in list_photos(tmp_path)] == ["own.jpg"]


@pytest.mark.parametrize("other", ["masks", "images_4", "train", "depth-maps", "input"])
def test_folders_of_a_data_set_are_not_mixed(tmp_path, other):
    for name in (other, "images", "video"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.png").write_bytes(b"")
    with pytest.raises(InputError, match="there are some in images/, give that folder"):
        list_photos(tmp_path)


def test_folders_without_photos_are_refused(tmp_path, caplog):
    with pytest.raises(InputError, match="no photo"):
        list_photos(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        list_photos(tmp_path / "missing")
    (tmp_path / "a.dng").write_bytes(b"")
    with pytest.raises(InputError, match="convert them to JPEG"):
        list_photos(tmp_path)


def test_photos_that_cannot_be_used_say_why(tmp_path):
    write_photo(tmp_path / "big.png", np.zeros((1000, 1001, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="1001 x 1000 is more than 1 megapixels"):
        read_photo(tmp_path / "big.png", max_megapixels=1.0)
    with pytest.raises(InputError, match="no such photo"):
        read_photo(tmp_path / "none.png")
    (tmp_path / "text.jpg").write_text("hello")
    with pytest.raises(InputError, match="not a photo"):
        read_photo(tmp_path / "text.jpg")
    Image.fromarray(np.zeros((4, 4), dtype=np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(InputError, match="32-bit"):
        read_photo(tmp_path / "float.tif")


def test_header_of_a_huge_image_is_refused_without_decoding(tmp_path):
    write_photo(tmp_path / "a.png", gradient())
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[16:24] = (65000).to_bytes(4, "big") * 2
    import zlib

    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match="65000 x 65000 is more than 250 megapixels"):
        read_photo(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
def test_damaged_photos_end_in_an_input_error_or_in_pixels(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(IFD.Exif)[0xA405] = 28
    exif.get_ifd(IFD.GPSInfo).update({1: "N", 2: (1.0, 2.0, 3.0), 3: "E", 4: (1.0, 2.0, 3.0)})
    Image.fromarray(gradient(60, 80)).save(path, exif=exif)

    def check(photo):
        assert photo.rgb.shape == (photo.info.height, photo.info.width, 3)

    loaded, refused = check_mutations(path, lambda: read_photo(path), check, count=400)
    assert min(loaded, refused) > 10


def test_real_photos_have_their_known_focal_length():
    folder = data_folder("lund_door") / "images"
    info = read_photo_info(list_photos(folder)[0])
    # The published model of these photos has f = 2435 px; EXIF rounds to whole millimetres.
    assert info.exif.focal_px == pytest.approx(2435.38, rel=0.1)


def test_heic_comes_upright_with_its_exif():
    """64 x 48 stored, EXIF orientation 6: red grows downwards and green to the left in the upright photo."""
    path = Path(__file__).parents[1] / "data" / "gradient.heic"
    photo = read_photo(path)
    assert photo.rgb.shape == (64, 48, 3)
    assert (photo.info.width, photo.info.height) == (48, 64)
    assert photo.info.exif.camera is not None
    assert "Gradient" in photo.info.exif.camera
    row, column = np.mgrid[0:64, 0:48]
    expected = np.stack([4 * row, 5 * (47 - column), np.full_like(row, 128)], axis=-1)
    assert np.abs(photo.rgb - expected.astype(np.int64)).mean() < 3


def test_heic_without_its_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(photos_module, "PHOTO_SUFFIXES", (".jpg",))
    monkeypatch.setattr(photos_module, "UNREADABLE_SUFFIXES", (".heic",))
    monkeypatch.setattr(photos_module, "ADVICE", "for HEIC: pip install 'fieldstone[heic]'")
    (tmp_path / "a.heic").write_bytes(b"")
    with pytest.raises(InputError, match=r"fieldstone\[heic\]"):
        list_photos(tmp_path)
