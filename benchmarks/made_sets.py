"""Photos that are made to be taken wrongly, with the truth: overlays, turntables, false EXIF, strangers among photos.

    python -m benchmarks.made_sets FOLDER [SET ...]

A set is written once: `made_set(name, folder)` gives its photos and its truth. All show the synthetic house or an
object on a turntable, through a pinhole camera of 560 px or nearly so.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.ExifTags import IFD, Base

from benchmarks.ground_truth import posed
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.synthetic.photos import (
    FULL_FRAME_DIAGONAL_MM,
    TRUTH_FILE,
    PhotoOptions,
    SyntheticPhotos,
    make_photos,
    read_truth,
    write_truth,
)
from fieldstone.synthetic.turntable import TurntableOptions, TurntablePhotos, photograph_turntable

Picture = UInt8[np.ndarray, "h w c"]

PHOTOS = 12
ZOOM = 1.8
BAR = 0.2
"""Share of the height that an overlay covers."""
LETTERBOX = 0.12
"""Share of the height of each of two black bars."""
DIGITAL_ZOOM_RATIO = 0xA404


def made_set(name: str, folder: Path) -> tuple[Path, Reconstruction]:
    """The folder of a set's photos, made unless it is there, and the truth of those that belong to the scene.

    Raises:
        KeyError: No set has this name.
    """
    make, out = MADE_SETS[name], folder / name
    if not out.is_dir():
        part = folder / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        make(part)
        part.rename(out)
    return out, read_truth(out / TRUTH_FILE)


@lru_cache(maxsize=1)
def house() -> SyntheticPhotos:
    """Ordinary photos of the house."""
    return make_photos(PhotoOptions(num_photos=PHOTOS, focal_35mm=30, arc_deg=110.0), np.random.default_rng(7))


@lru_cache(maxsize=1)
def turntable() -> TurntablePhotos:
    """A turn of the object before a textured background that stands still."""
    return photograph_turntable(TurntableOptions(), np.random.default_rng(3))


def write_house(
    out: Path,
    change: Callable[[Picture, int], Picture] = lambda image, k: image,
    focal_factor: Callable[[int], float | None] = lambda k: None,
    zoom: Callable[[int], float | None] = lambda k: None,
    strangers: Sequence[int] = (),
) -> None:
    """The photos of the house, changed, and the truth.

    Args:
        change: Of pixels and number of a photo.
        focal_factor: What EXIF makes of the true focal length of a photo; None: it is silent.
        zoom: Digital zoom that EXIF states.
        strangers: Photos that have no true pose.
    """
    photos = house()
    camera = photos.truth.cameras[0]
    for k, image in enumerate(photos.images):
        factor = focal_factor(k)
        focal = None if factor is None else factor * float(camera.params[0])
        save(out / name_of(k), change(image, k), focal, zoom(k))
    kept = [k for k in range(PHOTOS) if k not in strangers]
    poses = [photos.truth.pose_of(k) for k in kept]
    write_truth(posed([name_of(k) for k in kept], [camera] * len(kept), poses), out / TRUTH_FILE)


def name_of(k: int) -> str:
    """File name of a photo."""
    return f"IMG_{k:04d}.jpg"


def save(path: Path, pixels: Picture, focal_px: float | None = None, zoom: float | None = None) -> None:
    """Write a photo with a camera, the 35 mm equivalent of a focal length and a digital zoom in its EXIF."""
    exif = Image.Exif()
    if focal_px is not None:
        diagonal = float(np.hypot(*pixels.shape[:2]))
        exif[Base.Make], exif[Base.Model] = "fieldstone", "synthetic house"
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = round(focal_px / diagonal * FULL_FRAME_DIAGONAL_MM)
    if zoom is not None:
        exif.get_ifd(IFD.Exif)[DIGITAL_ZOOM_RATIO] = zoom
    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=exif)


def text_bar(image: Picture, k: int) -> Picture:
    """A dashcam's bar of text over the lower fifth; its clock runs."""
    height, width = image.shape[:2]
    rows = round(BAR * height)
    bar = np.full((rows, width, 3), 28, dtype=np.uint8)
    lines = (
        f"2026-11-30 12:{k // 60:02d}:{k % 60:02d}   FRONT CAMERA 1080P",
        "48.13743 N  11.57549 E   SPEED 057 KM/H   HEADING 214",
        "FLEET 0042  DRIVER 17  G-SENSOR OK  SD 62 %  GPS 11/14",
        "RECORDING  EVENT LOCK  PARKING OFF  MIC ON  TEMP 31 C",
    )
    for n, line in enumerate(lines):
        at = (8, int((n + 0.75) * rows / len(lines)))
        cv2.putText(bar, line, at, cv2.FONT_HERSHEY_SIMPLEX, width / 1150, (235, 235, 205), 1, cv2.LINE_AA)
    return np.concatenate([image[:-rows], bar])


def watermark(image: Picture, k: int) -> Picture:
    """Half transparent words across the photo, again and again."""
    words = np.zeros(image.shape[:2], dtype=np.uint8)
    for n in range(5):
        at = (30 + 45 * n, 70 + 90 * n)
        cv2.putText(words, "(C) Stock Photo Agency 2026", at, cv2.FONT_HERSHEY_DUPLEX, 0.9, 255, 2, cv2.LINE_AA)
    opacity = 0.45 * words[..., None].astype(np.float32) / 255.0
    return np.rint(image + opacity * (255.0 - image)).astype(np.uint8)


def letterbox(image: Picture, k: int) -> Picture:
    """Black bars above and below, and a broadcaster's sign in a corner."""
    out, rows = image.copy(), round(LETTERBOX * image.shape[0])
    out[:rows] = out[-rows:] = 0
    cv2.circle(out, (590, rows + 34), 22, (240, 240, 240), -1, cv2.LINE_AA)
    cv2.putText(out, "TV4", (573, rows + 41), cv2.FONT_HERSHEY_DUPLEX, 0.6, (200, 30, 30), 2, cv2.LINE_AA)
    return out


def mirrored_one(image: Picture, k: int) -> Picture:
    """The fifth photo left for right."""
    return np.ascontiguousarray(image[:, ::-1]) if k == 4 else image


def write_turntable(out: Path, *, alpha: bool) -> None:
    """The turntable, as JPEG files, or as PNG files whose alpha is the object and the plate."""
    photos = turntable()
    names = [Path(name_of(k)).with_suffix(".png" if alpha else ".jpg").name for k in range(len(photos.images))]
    for name, image, opacity in zip(names, photos.images, photos.alphas, strict=True):
        if alpha:
            Image.fromarray(np.dstack([image, opacity])).save(out / name)
        else:
            save(out / name, image)
    write_truth(posed(names, [photos.camera] * len(names), list(photos.poses)), out / TRUTH_FILE)


def ten_copies(out: Path) -> None:
    """The house, and ten copies of one of its photos, saved again, with ten different EXIF focal lengths."""
    write_house(out)
    for n in range(10):
        focal = float(house().truth.cameras[0].params[0]) * (0.6 + 0.12 * n)
        save(out / f"copy_{n}.jpg", house().images[5], focal)


def panorama_among(out: Path) -> None:
    """The house, and an equirectangular panorama among its photos, marked as such."""
    write_house(out)
    save_panorama(out / "PANO_0001.jpg", np.concatenate([house().images[2], house().images[8]], axis=1))


def save_panorama(path: Path, pixels: Picture) -> None:
    """Twice as wide as high, with the XMP of a panorama."""
    wide = cv2.resize(pixels, (2 * pixels.shape[0], pixels.shape[0]), interpolation=cv2.INTER_AREA)
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        'GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True"/></rdf:RDF></x:xmpmeta>'
    )
    Image.fromarray(wide).save(path, quality=95, xmp=xmp.encode())


MADE_SETS: dict[str, Callable[[Path], None]] = {
    "plain_house": write_house,
    "overlay": lambda out: write_house(out, text_bar),
    "watermark": lambda out: write_house(out, watermark),
    "letterbox": lambda out: write_house(out, letterbox),
    "turntable_background": lambda out: write_turntable(out, alpha=False),
    "turntable_rgba": lambda out: write_turntable(out, alpha=True),
    "exif_right": lambda out: write_house(out, focal_factor=lambda k: 1.0),
    "exif_zoom_1_8": lambda out: write_house(out, focal_factor=lambda k: 1 / ZOOM),
    "exif_zoom_1_8_stated": lambda out: write_house(out, focal_factor=lambda k: 1 / ZOOM, zoom=lambda k: ZOOM),
    "exif_too_long": lambda out: write_house(out, focal_factor=lambda k: ZOOM),
    "half_exif_wrong": lambda out: write_house(out, focal_factor=lambda k: ZOOM if k % 2 else 1.0),
    "mirrored_one": lambda out: write_house(out, mirrored_one, strangers=(4,)),
    "ten_copies": ten_copies,
    "panorama_among": panorama_among,
}
"""What writes the photos and the truth of every set into an empty folder."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Write sets into a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sets", nargs="*", choices=[*MADE_SETS, []], help="default: all")
    given = parser.parse_args(arguments)
    for name in given.sets or MADE_SETS:
        photos, truth = made_set(name, given.folder)
        sys.stdout.write(f"{photos}: {len(truth.views)} photos with a true pose\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
