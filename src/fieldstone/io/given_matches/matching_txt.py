"""Course folders: photos, `matching*.txt` with given matches, and `calibration.txt`.

`matchingI.txt` starts with `nFeatures: N`, the number of features found in photo I. Each further line is one of them:
the number of photos it is seen in (I included), its colour R G B, its place u v in photo I, and then, for every other
photo, id u v. Ids start at 1. Both files put the centre of the first pixel at (0, 0): see docs/conventions.md.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera, pinhole
from fieldstone.io.files.others import finite_word, finite_words, read_text
from fieldstone.io.given_matches.photos import GivenPhotos, find_photos
from fieldstone.io.images.photos import PhotoProblem
from fieldstone.scene.match_graph import ImagePair, MatchGraph

logger = logging.getLogger(__name__)

MATCHING_NAME = re.compile(r"matching(\d{1,6})\.txt", re.IGNORECASE)
CORNER_FROM_CENTER = 0.5
"""Added to pixels whose origin is the centre of the first pixel."""
MAX_COORDINATE = 1e6
MAX_SKEW = 1e-3
"""Largest |skew| / focal length that is ignored: half a pixel at the border of a 1000-pixel photo."""


@dataclass(frozen=True, eq=False)
class GivenMatches:
    """A data set with given matches: the graph and its camera, and what was left out on the way.

    photos: the file of each photo of the graph; None where the folder has matches but no photos.
    """

    graph: MatchGraph
    camera: Camera
    photos: tuple[Path | None, ...]
    num_given: Mapping[ImagePair, int]
    """Matches in the files between two photos of the graph, repetitions included."""
    num_repeated: int
    """Matches that a file gives more than once."""
    dropped_by_missing_photo: Mapping[int, int]
    """Matches left out because they name a photo that the folder lacks, by that photo's id in the files."""
    problems: tuple[PhotoProblem, ...]
    """Photos that cannot be decoded; they count as missing."""


@dataclass(frozen=True, eq=False)
class _MatchingFile:
    """The rows of one file: r features of photo `image`, and e places where they are seen in other photos."""

    path: Path
    image: int
    pixels: Float[np.ndarray, "r 2"]
    rgb: UInt8[np.ndarray, "r 3"]
    line: Int[np.ndarray, "r"]
    entry_row: Int[np.ndarray, "e"]
    entry_image: Int[np.ndarray, "e"]
    entry_pixels: Float[np.ndarray, "e 2"]


def is_given_matches_folder(folder: Path) -> bool:
    """The folder holds match files, so it is meant to be read by this module."""
    return folder.is_dir() and any(MATCHING_NAME.fullmatch(p.name) for p in folder.iterdir())


def read_given_matches(folder: Path) -> GivenMatches:
    """Read calibration, photos and matches of a data set with given matches; pixels in our convention.

    A place in a photo is one keypoint, in however many lines and files it appears. Matches that name a photo which
    the folder lacks (or which cannot be decoded) are left out and counted. Without any photo, the ids in the files
    say which photos there are, and the principal point and the keypoints how large they are.

    Raises:
        InputError: A file is missing or damaged (the message names file and line), an id belongs to no photo of the
            data set, or no match is left.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder with the photos and matching1.txt")
    K = read_calibration(folder / "calibration.txt")
    files = [_read_matching_file(path, image) for image, path in _matching_paths(folder)]
    photos = find_photos(folder, last_with_matches=max(f.image for f in files) + 1)
    if photos.paths:
        for file in files:
            _check_against_photos(file, photos)
        ids = sorted(photos.paths)
    else:
        ids = sorted({f.image for f in files} | {int(i) for f in files for i in np.unique(f.entry_image)})
    keypoints, colors, index = _keypoint_tables(files, ids)
    rows, dropped = _match_rows(files, ids, index)
    num_given = {pair: len(rows[pair]) for pair in sorted(rows)}
    matches = {pair: np.unique(rows[pair], axis=0) for pair in num_given}
    num_left, num_dropped = sum(len(m) for m in matches.values()), sum(dropped.values())
    if dropped:
        logger.warning(
            "%s: dropped %d of %d matches, their photos are missing: %s",
            folder,
            num_dropped,
            num_dropped + sum(num_given.values()),
            ", ".join(f"photo {i} ({n} matches)" for i, n in sorted(dropped.items())),
        )
    if not num_left:
        raise InputError(f"{folder}: none of its {num_dropped} matches joins two photos of the folder; add the photos")
    logger.info("read %d matches of %d pairs of %d photos from %s", num_left, len(matches), len(ids), folder)
    names = tuple(photos.paths[i].name if photos.paths else f"{i}.png" for i in ids)
    camera = pinhole(*(photos.size or _size_from_contents(K, keypoints)), K)
    paths = tuple(photos.paths.get(i) for i in ids)
    graph = MatchGraph(names, keypoints, colors, matches)
    num_repeated = sum(num_given.values()) - num_left
    return GivenMatches(graph, camera, paths, num_given, num_repeated, dropped, photos.problems)


def read_calibration(path: Path) -> Float[np.ndarray, "3 3"]:
    """K from a plain 3x3 text or from MATLAB's `K = [a b c; d e f; g h i]`, principal point in our convention.

    Raises:
        InputError: Missing, not nine finite numbers, a focal length that is not positive, or not of the form
            [fx 0 cx; 0 fy cy; 0 0 1].
    """
    numbers: list[tuple[float, int]] = []
    for line, text in enumerate(_read_lines(path), start=1):
        content = re.sub(r"[%#].*", "", text)
        content = re.sub(r"^\s*[A-Za-z]\w*\s*=", " ", content)
        for token in re.sub(r"[\[\];,]", " ", content).split():
            numbers.append((finite_word(token, f"{path}, line {line}"), line))
    if len(numbers) != 9:
        _refuse(path, numbers[-1][1] if numbers else 1, f"a 3x3 matrix K has 9 numbers, found {len(numbers)}")
    K = np.array([value for value, _ in numbers]).reshape(3, 3)
    lines = np.array([line for _, line in numbers]).reshape(3, 3)
    for i in (0, 1):
        if not K[i, i] > 0:
            _refuse(path, int(lines[i, i]), f"focal length {K[i, i]:g} is not positive; give it in pixels")
        if abs(K[i, 2]) > MAX_COORDINATE:
            _refuse(path, int(lines[i, 2]), f"principal point {K[i, 2]:g} is beyond any photo; give it in pixels")
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-9:
        _refuse(path, int(lines[2, 0]), f"the last row of K must be 0 0 1, got {K[2].tolist()}; is K transposed?")
    if abs(K[1, 0]) > 1e-9 or abs(K[0, 1]) > MAX_SKEW * K[0, 0]:
        _refuse(path, int(lines[0, 1]), "K has skew, which is not supported; undistort the photos to square axes")
    if K[0, 1] != 0:
        logger.warning("%s: skew %g ignored (%g of the focal length)", path, K[0, 1], K[0, 1] / K[0, 0])
        K[0, 1] = 0.0
    K[:2, 2] += CORNER_FROM_CENTER
    return K


def _matching_paths(folder: Path) -> list[tuple[int, Path]]:
    """(photo id, file), by id."""
    found = [(int(m[1]), p) for p in folder.iterdir() if (m := MATCHING_NAME.fullmatch(p.name))]
    if not found:
        raise InputError(f"{folder}: no matching*.txt; give a folder with matching1.txt, or photos to match yourself")
    found.sort()
    for (a, first), (b, second) in pairwise(found):
        if a == b:
            raise InputError(f"{folder}: {first.name} and {second.name} both belong to photo {a}; remove one")
    if found[0][0] == 0:
        raise InputError(f"{found[0][1]}: photo ids start at 1; rename the file")
    return found


def _read_matching_file(path: Path, image: int) -> _MatchingFile:
    """Parse one file; everything that can be checked without the other files is checked."""
    lines = _read_lines(path)
    first = next((k for k, text in enumerate(lines) if text.strip()), 0)
    num_features = _feature_count(path, first + 1, lines[first] if lines else "")
    tokens = [text.split() for text in lines[first + 1 :]]
    length = np.array([len(t) for t in tokens], dtype=np.int64)
    line = np.flatnonzero(length) + first + 2
    length = length[length > 0]
    values = finite_words(path, tokens, range(first + 2, first + 2 + len(tokens)))
    start = np.cumsum(length) - length

    _check_rows(path, line, length < 6, "a feature needs at least 6 numbers: count, R G B, u v")
    count = values[start]
    _check_rows(path, line, (count < 1) | (count != np.round(count)), "the number of photos must be 1 or more")
    expected = 6 + 3 * (count - 1)
    _check_rows(path, line, length != expected, "the number of photos does not fit the length of the line")
    rgb = values[start[:, None] + np.arange(1, 4)]
    _check_rows(path, line, np.any((rgb < 0) | (rgb > 255), axis=1), "R G B must lie in 0..255")

    num_entries = (count - 1).astype(np.int64)
    entry_row = np.repeat(np.arange(len(start)), num_entries)
    within = np.arange(len(entry_row)) - np.repeat(np.cumsum(num_entries) - num_entries, num_entries)
    entry_start = start[entry_row] + 6 + 3 * within
    entry_image = values[entry_start]
    entry_pixels = values[entry_start[:, None] + np.arange(1, 3)]
    pixels = values[start[:, None] + np.arange(4, 6)]
    for places, at in ((pixels, line), (entry_pixels, line[entry_row])):
        _check_rows(path, at, np.any(places < 0, axis=1), "a coordinate is negative")
        _check_rows(path, at, np.any(places > MAX_COORDINATE, axis=1), "a coordinate is beyond any photo")
    wrong_id = (entry_image < 1) | (entry_image != np.round(entry_image)) | (entry_image > 1e6)
    _check_rows(path, line[entry_row], wrong_id, "photo ids are whole numbers from 1")
    _check_rows(path, line[entry_row], entry_image == image, f"photo {image} is matched with itself")
    distinct = len(np.unique(pixels, axis=0))
    if distinct > num_features:
        _refuse(path, first + 1, f"nFeatures is {num_features}, but {distinct} features follow; correct the count")
    return _MatchingFile(
        path,
        image,
        pixels + CORNER_FROM_CENTER,
        np.round(rgb).astype(np.uint8),
        line,
        entry_row,
        entry_image.astype(np.int64),
        entry_pixels + CORNER_FROM_CENTER,
    )


def _feature_count(path: Path, line: int, text: str) -> int:
    """N of the first line `nFeatures: N`."""
    header = re.fullmatch(r"\s*nFeatures\s*:\s*(\S+)\s*", text, re.IGNORECASE)
    if not header:
        _refuse(path, line, f"the first line must be `nFeatures: N`, got {text.strip()[:40]!r}")
    if not re.fullmatch(r"\d{1,12}", header[1], re.ASCII):
        _refuse(path, line, f"nFeatures must be a whole number, got {header[1][:40]!r}; correct the count")
    return int(header[1])


def _check_against_photos(file: _MatchingFile, photos: GivenPhotos) -> None:
    """Ids belong to the data set, and places lie inside the photos."""
    line = file.line[file.entry_row]
    beyond = file.entry_image > photos.num_images
    first = file.entry_image[np.argmax(beyond)] if len(beyond) else 0
    _check_rows(file.path, line, beyond, f"photo {first} does not exist: the data set has {photos.num_images} photos")
    if photos.size is not None:
        width, height = photos.size
        where = f"a coordinate is outside the photo of {width} x {height} pixels"
        _check_rows(file.path, file.line, np.any(file.pixels > [width, height], axis=1), where)
        _check_rows(file.path, line, np.any(file.entry_pixels > [width, height], axis=1), where)


def _keypoint_tables(
    files: list[_MatchingFile], ids: list[int]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...], dict[tuple[int, int], np.ndarray]]:
    """One keypoint per place and photo, sorted by (u, v), with its colour.

    Also returns where each file's places went: key (file, -1) for the rows' own places, and (file, image) for the
    entries in that image, in the order of the file.
    """
    keypoints, colors = [], []
    index: dict[tuple[int, int], np.ndarray] = {}
    for image in ids:
        # Own rows first: they decide the colour of a place that other files name too.
        own = [(k, -1, f.pixels, f.rgb) for k, f in enumerate(files) if f.image == image]
        seen = [
            (k, image, f.entry_pixels[at], f.rgb[f.entry_row[at]])
            for k, f in enumerate(files)
            if len(at := np.flatnonzero(f.entry_image == image))
        ]
        parts = own + seen
        pixels = np.concatenate([np.empty((0, 2)), *(p for _, _, p, _ in parts)])
        rgb = np.concatenate([np.empty((0, 3), dtype=np.uint8), *(c for _, _, _, c in parts)])
        places, first, inverse = np.unique(pixels, axis=0, return_index=True, return_inverse=True)
        keypoints.append(places)
        colors.append(rgb[first])
        splits = np.cumsum([len(p) for _, _, p, _ in parts])[:-1]
        for (k, key, _, _), numbers in zip(parts, np.split(inverse.ravel(), splits), strict=True):
            index[k, key] = numbers
    return tuple(keypoints), tuple(colors), index


def _match_rows(
    files: list[_MatchingFile], ids: list[int], index: dict[tuple[int, int], np.ndarray]
) -> tuple[dict[ImagePair, Int[np.ndarray, "m 2"]], dict[int, int]]:
    """Matches per pair, repetitions included; how many name each missing photo."""
    dense = {image: k for k, image in enumerate(ids)}
    rows: dict[ImagePair, list[np.ndarray]] = {}
    dropped: dict[int, int] = {}
    for k, file in enumerate(files):
        for image in np.unique(file.entry_image).tolist():
            at = np.flatnonzero(file.entry_image == image)
            missing = next((i for i in (file.image, image) if i not in dense), None)
            if missing is not None:
                dropped[missing] = dropped.get(missing, 0) + len(at)
                continue
            i, j = dense[file.image], dense[image]
            pair_rows = np.stack([index[k, -1][file.entry_row[at]], index[k, image]], axis=1)
            if i > j:
                i, j, pair_rows = j, i, pair_rows[:, ::-1]
            rows.setdefault((i, j), []).append(pair_rows)
    return {pair: np.concatenate(parts) for pair, parts in rows.items()}, dropped


def _size_from_contents(K: Float[np.ndarray, "3 3"], keypoints: tuple[np.ndarray, ...]) -> tuple[int, int]:
    """(width, height) that is centred on the principal point, or larger if keypoints lie beyond."""
    beyond = np.concatenate(keypoints).max(axis=0)
    width, height = np.ceil(np.maximum(2 * K[:2, 2], beyond)).astype(int).tolist()
    return width, height


def _read_lines(path: Path) -> list[str]:
    """Lines of a text file with any line ends."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; a data set with given matches needs calibration.txt and matching*.txt")
    return read_text(path).replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _check_rows(path: Path, line: Int[np.ndarray, "n"], wrong: np.ndarray, why: str) -> None:
    """Refuse the file at the first wrong row."""
    bad = np.flatnonzero(wrong)
    if len(bad):
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        _refuse(path, int(line[bad[0]]), f"{why}{more}; correct or remove the line")


def _refuse(path: Path, line: int, why: str) -> NoReturn:
    raise InputError(f"{path}, line {line}: {why}")
