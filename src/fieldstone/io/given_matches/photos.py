"""Which photos a data set with given matches holds, and which ids its match files know them by."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fieldstone.errors import InputError
from fieldstone.io.images.photos import PHOTO_SUFFIXES, PhotoProblem, natural_key, read_photo

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class GivenPhotos:
    """The photos of a data set with given matches.

    paths: by id, readable photos only, empty if the folder holds none. size: (width, height), None without photos.
    num_images: photos of the whole data set, those that the folder lacks included.
    """

    paths: Mapping[int, Path]
    size: tuple[int, int] | None
    num_images: int
    problems: tuple[PhotoProblem, ...]


def find_photos(folder: Path, *, last_with_matches: int) -> GivenPhotos:
    """Photos of the folder by id: the number that is the file's name, else the place in natural order.

    Args:
        last_with_matches: The highest id that the names of the match files imply; the data set has at least as many
            photos. (The last photo has no file of its own, because each file lists only later photos.)

    Raises:
        InputError: Two photos have one number, none of the photos can be read, or their sizes differ.
    """
    by_id = _by_id(folder)
    paths: dict[int, Path] = {}
    sizes: dict[tuple[int, int], Path] = {}
    problems: list[PhotoProblem] = []
    for image, path in by_id.items():
        try:
            info = read_photo(path).info
        except InputError as error:
            logger.warning("skipped %s", error)
            problems.append(PhotoProblem(path, str(error)))
            continue
        paths[image] = path
        sizes.setdefault((info.width, info.height), path)
    if by_id and not paths:
        raise InputError(f"none of {len(by_id)} photos can be read; the first: {problems[0].reason}")
    if len(sizes) > 1:
        (a, first), (b, second) = list(sizes.items())[:2]
        raise InputError(
            f"{second}: {b[0]} x {b[1]} pixels, but {first.name} has {a[0]} x {a[1]}; "
            "calibration.txt holds one K, so all photos need one size"
        )
    num_images = max(last_with_matches, *by_id) if by_id else last_with_matches
    return GivenPhotos(paths, next(iter(sizes), None), num_images, tuple(problems))


def _by_id(folder: Path) -> dict[int, Path]:
    """All photo files by id, whether readable or not."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith(".")]
    files.sort(key=lambda p: natural_key(p.name))
    numbered = [p for p in files if p.stem.isascii() and p.stem.isdigit() and 0 < int(p.stem) <= 10**6]
    if not numbered:
        return dict(enumerate(files, start=1))
    by_id: dict[int, Path] = {}
    for path in numbered:
        image = int(path.stem)
        if image in by_id:
            raise InputError(f"{folder}: {by_id[image].name} and {path.name} are both photo {image}; remove one")
        by_id[image] = path
    if len(numbered) < len(files):
        logger.warning("%s: %d photos whose names are no numbers are left out", folder, len(files) - len(numbered))
    return by_id
