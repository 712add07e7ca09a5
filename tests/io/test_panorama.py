"""A panorama is one because its XMP says so, whatever its shape."""

import numpy as np
import pytest
from PIL import Image

from fieldstone.io.images.photos import read_photo_info

ATTRIBUTE = 'GPano:ProjectionType="equirectangular"'
ELEMENT = "<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
VIEWER = 'GPano:UsePanoramaViewer="True"'
SILENT = ['GPano:UsePanoramaViewer="False"', 'dc:subject="GPano"', 'GPano:ProjectionType="rectilinear"']


def xmp(words):
    inside = f"<rdf:Description {'' if words.startswith('<') else words}>{words if words.startswith('<') else ''}"
    return f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF>{inside}</rdf:Description></rdf:RDF></x:xmpmeta>'.encode()


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
@pytest.mark.parametrize("words", [ATTRIBUTE, ELEMENT, VIEWER, *SILENT])
def test_xmp_decides(tmp_path, suffix, words):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(np.zeros((8, 16, 3), dtype=np.uint8)).save(path, xmp=xmp(words))
    assert read_photo_info(path).panorama == (words not in SILENT)


def test_twice_as_wide_as_high_is_no_panorama_for_that(tmp_path):
    Image.fromarray(np.zeros((8, 16, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    assert not read_photo_info(tmp_path / "a.png").panorama


def test_tags_of_png_and_tiff_are_read(tmp_path):
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp(ATTRIBUTE).decode())
    image = Image.fromarray(np.zeros((8, 16, 3), dtype=np.uint8))
    image.save(tmp_path / "a.png", pnginfo=info)
    image.save(tmp_path / "a.tif", tiffinfo={700: xmp(ATTRIBUTE)})
    assert read_photo_info(tmp_path / "a.png").panorama
    assert read_photo_info(tmp_path / "a.tif").panorama
