"""Photos: decoded upright once, with what their EXIF says about focal length, camera and place."""

from __future__ import annotations

import io
import logging
import math
import re
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import replacing
from fieldstone.io.images.exif import ExifFacts, exif_facts
from fieldstone.io.images.heic import HAS_HEIC, HEIC_SUFFIXES, teach_pillow
from fieldstone.io.images.panorama import is_panorama

logger = logging.getLogger(__name__)

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", *(HEIC_SUFFIXES if HAS_HEIC else ()))
UNREADABLE_SUFFIXES = (".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
UNREADABLE_SUFFIXES += () if HAS_HEIC else HEIC_SUFFIXES
ADVICE = "convert them to JPEG" if HAS_HEIC else "convert them to JPEG (for HEIC: pip install 'fieldstone[heic]')"
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", *(("HEIF",) if HAS_HEIC else ()))
"""The only decoders that a photo may reach."""
MAX_MEGAPIXELS = 250.0
ORIGINALS = "images"
"""Where data sets keep their photos."""
LAYOUT_FOLDERS = (ORIGINALS, "input", "train", "test", "val", "mask", "masks", "depth", "depths", "normals", "renders")
"""First words of the names of folders that data sets consist of."""

UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What turns the stored pixels upright, by EXIF orientation (1: nothing)."""

DAMAGE = (
    OSError,
    SyntaxError,  # how the PNG decoder reports a broken chunk
    ValueError,
    EOFError,
    IndexError,
    KeyError,
    TypeError,
    OverflowError,
    ZeroDivisionError,
    MemoryError,
    AttributeError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)
"""What Pillow raises on damaged files, found by mutating them."""

_pillow_limits = threading.Lock()


@dataclass(frozen=True)
class PhotoInfo:
    """What the header says of a photo, without decoding it; width and height are those of the upright photo."""

    path: Path
    width: int
    height: int
    orientation: int
    """EXIF orientation of the stored pixels, 1 to 8; reading turns them upright."""
    exif: ExifFacts
    panorama: bool = False
    """It is the picture of a sphere or a cylinder, see `panorama`."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A decoded photo, upright, sRGB. alpha is straight (colours are not multiplied by it), None if opaque."""

    info: PhotoInfo
    pixels: UInt8[np.ndarray, "h w c"]
    """RGB, or RGBA where there is alpha."""

    @property
    def rgb(self) -> UInt8[np.ndarray, "h w 3"]:
        """Colours alone."""
        return np.ascontiguousarray(self.pixels[:, :, :3])

    @property
    def alpha(self) -> UInt8[np.ndarray, "h w"] | None:
        """Opacity alone."""
        return np.ascontiguousarray(self.pixels[:, :, 3]) if self.pixels.shape[2] == 4 else None


@dataclass(frozen=True)
class PhotoProblem:
    """A file that is no usable photo, and why."""

    path: Path
    reason: str
    kind: str = "not readable"


def natural_key(name: str) -> tuple:
    """Sort key that counts: `img2` before `img10`; ties are broken by the plain name."""
    parts = re.split(r"(\d+)", name.casefold())
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts), name


def list_photos(folder: Path) -> list[Path]:
    """The photos of a folder in natural order of their names; hidden files are no photos.

    A folder without photos of its own may have them in several folders, as of two cameras or days: then they are the
    photos of all of these. Pictures that lie beside photos in a folder below are none: masks, thumbnails, renders.

    Raises:
        InputError: No such folder, or no photo in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder that holds the photos")
    files = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")]
    photos = [p for p in files if p.suffix.lower() in PHOTO_SUFFIXES]
    unreadable = [p.name for p in files if p.suffix.lower() in UNREADABLE_SUFFIXES]
    if unreadable:
        logger.warning("%s: %d files cannot be read, %s: %s", folder, len(unreadable), ADVICE, unreadable[:5])
    if not photos:
        below = [p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and _has_photos(p)]
        below.sort(key=lambda p: natural_key(p.name))
        if len(below) > 1 and not any(_is_of_a_layout(p.name) for p in below):
            logger.info("photos of %d folders: %s", len(below), ", ".join(p.name for p in below))
            return [photo for each in below for photo in list_photos(each)]
        reason = f"only formats that cannot be read; {ADVICE}" if unreadable else "no photo"
        best = min(below, key=lambda p: p.name != ORIGINALS, default=None)
        where = f"; there are some in {best.name}/, give that folder" if best else ""
        raise InputError(f"{folder}: {reason}{where} (read: {', '.join(PHOTO_SUFFIXES)})")
    return sorted(photos, key=lambda p: natural_key(p.name))


def photo_name(path: Path, folder: Path) -> str:
    """The name of a photo: its path below the folder, with `/`; its last part if it lies elsewhere."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def _has_photos(folder: Path) -> bool:
    return any(p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith(".") for p in folder.iterdir())


def _is_of_a_layout(name: str) -> bool:
    """Whether a folder is named as one of a data set: others beside it hold the same photos again, or none."""
    return re.split(r"[_\W\d]", name.casefold())[0] in LAYOUT_FOLDERS


def read_photo_info(path: Path, *, max_megapixels: float = MAX_MEGAPIXELS) -> PhotoInfo:
    """Size, orientation and EXIF of a photo from its header.

    Raises:
        InputError: Missing, no photo of a known format, or larger than `max_megapixels`.
    """
    with _opened(path, max_megapixels) as (_, info):
        return info


def read_photo(path: Path, *, at_least_px: int | None = None, max_megapixels: float = MAX_MEGAPIXELS) -> Photo:
    """Decode a photo and turn it upright. 16-bit channels keep their upper 8 bits; grey becomes RGB.

    Args:
        at_least_px: The pixels may be those of a smaller picture, if its longer side has at least so many: a JPEG is
            decoded at a half, a quarter or an eighth of its size in a fraction of the time.

    Raises:
        InputError: Missing, damaged, truncated, of an unknown format, or larger than `max_megapixels`.
    """
    with _opened(path, max_megapixels) as (image, info):
        try:
            if at_least_px is not None:
                share = at_least_px / max(image.size)
                image.draft(None, (math.ceil(share * image.width), math.ceil(share * image.height)))
            image.load()
            image = _eight_bit(image)
            if info.orientation in UPRIGHT:
                image = image.transpose(UPRIGHT[info.orientation])
            pixels = np.asarray(image)
        except DAMAGE as error:
            raise InputError(f"{path}: damaged or truncated photo ({_reason(error)}); copy it again") from error
    return Photo(info, pixels)


def write_photo(path: Path, rgb: UInt8[np.ndarray, "h w c"], *, quality: int = 95) -> None:
    """Write sRGB or RGBA pixels (straight alpha), format by suffix, whole or not at all.

    Args:
        quality: Of JPEG and WebP, 1 to 100; PNG and TIFF are exact.

    Raises:
        ValueError: A suffix that Pillow does not write.
    """
    with replacing(path) as temporary:
        Image.fromarray(rgb).save(temporary, quality=quality)


def png_bytes(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """RGB or RGBA pixels as a PNG file in memory."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def pixels_of_png(data: bytes) -> UInt8[np.ndarray, "h w c"]:
    """The pixels of `png_bytes`."""
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image)


def turned_upright(pixels: UInt8[np.ndarray, "h w"], orientation: int) -> UInt8[np.ndarray, "_ _"]:
    """Stored pixels turned as EXIF says, see `UPRIGHT`."""
    if orientation not in UPRIGHT:
        return pixels
    return np.asarray(Image.fromarray(pixels).transpose(UPRIGHT[orientation]))


@contextmanager
def _opened(path: Path, max_megapixels: float) -> Iterator[tuple[Image.Image, PhotoInfo]]:
    """The image, not yet decoded, and what its header says."""
    if not path.is_file():
        raise InputError(f"{path}: no such photo")
    if HAS_HEIC:  # whatever its name: phones and messengers rename
        teach_pillow()
    with path.open("rb") as file:
        # Pillow's limit on pixels and its warnings about EXIF are process-wide; ours is per call.
        with _pillow_limits, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(file, formats=FORMATS)
                orientation, facts = exif_facts(image)
                panorama = is_panorama(image)
            except DAMAGE as error:
                known = ", ".join(PHOTO_SUFFIXES)
                raise InputError(f"{path}: not a photo that can be read ({_reason(error)}); read: {known}") from error
            finally:
                Image.MAX_IMAGE_PIXELS = limit
        width, height = image.size
        if width * height > max_megapixels * 1e6:
            raise InputError(
                f"{path}: {width} x {height} is more than {max_megapixels:g} megapixels; "
                "make it smaller, or raise the limit"
            )
        if orientation >= 5:
            width, height = height, width
        yield image, PhotoInfo(path, width, height, orientation, facts, panorama)


def _eight_bit(image: Image.Image) -> Image.Image:
    """RGB or RGBA, 8 bits per channel."""
    if image.mode in ("RGB", "RGBA"):
        return image
    if image.mode.startswith("I;16"):
        image = Image.fromarray((np.asarray(image, dtype=np.uint16) >> 8).astype(np.uint8))
    elif image.mode in ("I", "F"):
        raise ValueError("32-bit channels are not supported, convert to 8 or 16 bits")
    return image.convert("RGBA" if image.has_transparency_data else "RGB")


def _reason(error: BaseException) -> str:
    """One line, without the object addresses that Pillow prints."""
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return re.sub(r"<_io\.\w+ name=.*?>", "file", text)
