"""Masks of photos: white is kept, black is left out."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from fieldstone.errors import InputError
from fieldstone.io.images.photos import (
    PHOTO_SUFFIXES,
    Photo,
    PhotoInfo,
    photo_name,
    read_photo,
    read_photo_info,
    turned_upright,
)

logger = logging.getLogger(__name__)

MIN_WHITE = 128
"""Grey level from which a pixel is kept: the blacks of a JPEG are not all 0."""
OPAQUE = 250
"""Alpha from which a pixel is opaque: those of lossy formats are not all 255."""
SILHOUETTE_PX, SILHOUETTE_SHARE = 2.0, 0.003
"""How far pixels are kept off a silhouette's edge: in pixels, and as a share of the longer side, whichever is more."""
MIN_KEPT = 0.05
"""Masks that keep a smaller share of their photos may have black and white the wrong way round."""


def find_masks(folder: Path, photos: Mapping[str, Path]) -> dict[Path, Path]:
    """The mask of every photo that has one: for `a.jpg` it is `a.jpg.png`, `a.jpg` or `a.png`, in this order.

    Args:
        photos: By name. One that leads through folders leads through folders of the same names here; without these its
            last part is enough, if no other photo has the same.

    Raises:
        InputError: No such folder, no mask in it for any of the photos, or a mask of another size than its photo.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; `masks` names the folder that holds one mask for each photo")
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix.lower() in PHOTO_SUFFIXES)
    by_name = {photo_name(path, folder): path for path in files}
    by_stem = {_without_suffix(name): path for name, path in by_name.items()}
    last_part = Counter(PurePosixPath(name).name for name in photos)
    found = {}
    for name, photo in photos.items():
        short = PurePosixPath(name).name
        candidates = [name, short] if last_part[short] == 1 else [name]
        of_each = ((by_name.get(f"{n}.png"), by_name.get(n), by_stem.get(_without_suffix(n))) for n in candidates)
        mask = next((mask for masks in of_each for mask in masks if mask is not None), None)
        if mask is not None:
            found[photo] = mask
    if photos and not found:
        example = next(iter(photos))
        raise InputError(
            f"{folder}: no mask for any of {len(photos)} photos; the mask of {example} is looked for as "
            f"{example}.png, {example} or {_without_suffix(example)}.png"
        )
    without = [name for name, photo in photos.items() if photo not in found]
    if without:
        logger.warning("%d of %d photos have no mask and are used whole: %s", len(without), len(photos), without[:5])
    _check_sizes(found)
    return found


def _without_suffix(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix()


def read_mask(path: Path, photo: PhotoInfo) -> Bool[np.ndarray, "h w"]:
    """Which pixels of the upright photo are kept.

    A mask of the stored size of a photo that EXIF turns by 90 degrees is turned with it; every other mask is taken as
    upright. White is 255, or 1 where a mask has no larger value.

    Raises:
        InputError: The mask cannot be read, or has another size than the photo.
    """
    grey = read_photo(path).rgb.max(axis=2)
    if not _is_upright(grey, photo):
        grey = turned_upright(grey, photo.orientation)
    if grey.shape != (photo.height, photo.width):
        raise InputError(f"{path}: the mask of {photo.path.name} has another size than the photo")
    return grey >= (MIN_WHITE if grey.max() > 1 else 1)


def inside_opaque(photo: Photo) -> Bool[np.ndarray, "h w"] | None:
    """Which pixels of a photo with alpha are opaque and off the silhouette's edge; None: all.

    At the edge pixels are mixed of object and background, and the outline itself is another curve of the object from
    every side.

    Raises:
        InputError: No pixel is.
    """
    if photo.alpha is None:
        return None
    opaque = photo.alpha >= OPAQUE
    if opaque.all():
        return None
    margin = max(SILHOUETTE_PX, SILHOUETTE_SHARE * max(opaque.shape))
    inside = cv2.distanceTransform(opaque.astype(np.uint8), cv2.DIST_L2, 5) > margin
    if not inside.any():
        raise InputError(f"{photo.info.path}: its alpha leaves no pixel opaque; save it without alpha")
    return inside


def on_mean_colour(photo: Photo) -> UInt8[np.ndarray, "h w 3"]:
    """The photo with its mean colour where its alpha is not opaque: what is stored there is seen by nobody."""
    rgb, alpha = photo.rgb, photo.alpha
    if alpha is not None and (opaque := alpha >= OPAQUE).any():
        rgb[~opaque] = rgb[opaque].mean(axis=0)
    return rgb


def check_polarity(kept: Sequence[float]) -> None:
    """Warn if masks keep next to nothing.

    Args:
        kept: Share of the pixels that each mask keeps.

    Raises:
        InputError: They keep nothing at all.
    """
    if not len(kept):
        return
    if max(kept) == 0.0:
        raise InputError("the masks keep no pixel of any photo: white is kept, black is left out; invert them")
    median = float(np.median(kept))
    if median < MIN_KEPT:
        logger.warning(
            "the masks keep only %.1f %% of the pixels: white is kept, black left out; are they the wrong way round?",
            100 * median,
        )


def _check_sizes(masks: dict[Path, Path]) -> None:
    """One error for all masks that do not fit. Photos that cannot be read are reported where they are decoded."""
    wrong = []
    for photo_path, mask_path in masks.items():
        mask = read_photo_info(mask_path)
        try:
            photo = read_photo_info(photo_path)
        except InputError:
            continue
        sizes = {(photo.width, photo.height), (photo.height, photo.width) if photo.orientation >= 5 else None}
        if (mask.width, mask.height) not in sizes:
            wrong.append(f"{mask_path}: {mask.width} x {mask.height} for a photo of {photo.width} x {photo.height}")
    if wrong:
        more = f", and {len(wrong) - 1} more like it" if len(wrong) > 1 else ""
        raise InputError(f"{wrong[0]}{more}; a mask has the size of its photo")


def _is_upright(grey: UInt8[np.ndarray, "h w"], photo: PhotoInfo) -> bool:
    return photo.orientation < 5 or grey.shape == (photo.height, photo.width)
