"""Photos to features, each photo once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from fieldstone.errors import InputError
from fieldstone.features.sift import Sift, reduced_grey
from fieldstone.io.files.cache import Unit, UnitCache, code_version, file_hash, key_of
from fieldstone.io.files.names import name_problem
from fieldstone.io.images.masks import check_polarity, find_masks, read_mask
from fieldstone.io.images.photos import PhotoInfo, PhotoProblem, read_photo, read_photo_info
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.scene.features import Features

STAGE = "features"


@dataclass(frozen=True, eq=False)
class DetectedPhoto:
    """A photo whose features are known; its pixels are not kept."""

    info: PhotoInfo
    features: Features
    key: str
    """Hash of what the features depend on."""
    kept: float = 1.0
    """Share of the pixels that the mask keeps."""
    sharpness: float = 1.0
    """See `sharpness`."""
    mask: Path | None = None
    faint: bool = False
    """Features of low contrast are among them, for there were too few others."""
    static_cells: Bool[np.ndarray, "_ _"] | None = None
    """Cells of the photo in which nothing moves with the scene, see `features.static_content`; None: there are none."""

    def pixel_scale(self, max_image_size: int) -> float:
        """Pixels of the photo per pixel of the detector at its finest; 1 for a photo that is not reduced."""
        return max(1.0, max(self.info.width, self.info.height) / max_image_size)

    def pixels(self) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
        """The photo, decoded, and which of its pixels are kept; None: all."""
        keep = None if self.mask is None else read_mask(self.mask, self.info)
        if self.static_cells is not None:
            size = self.info.width, self.info.height
            moves = cv2.resize((~self.static_cells).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            keep = moves if keep is None else keep & moves
        return read_photo(self.info.path).rgb, keep

    def without(self, static: Bool[np.ndarray, "n"], cells: Bool[np.ndarray, "_ _"] | None) -> DetectedPhoto:
        """The photo without the features that do not move with the scene, and without cells in which nothing does."""
        key = key_of(self.key, np.packbits(static).tobytes().hex())
        return replace(self, features=self.features[~static], key=key, static_cells=cells)


def detect(
    paths: Sequence[Path],
    options: MatchingOptions,
    cache: UnitCache,
    on_progress: OnProgress = silent,
) -> tuple[list[DetectedPhoto], list[PhotoProblem]]:
    """Features of every readable photo, in the order of the paths, and the files that are not used.

    Of several photos with the same content only the first is used: the others would count its observations twice.
    Decoding and extraction release the interpreter lock. A photo is let go as soon as its features are known.

    Raises:
        InputError: The masks do not fit the photos.
    """
    extractor = Sift(options.sift)
    masks = {} if options.masks is None else find_masks(options.masks, paths)
    progress = StageProgress(on_progress, "finding features", len(paths))

    def one(path: Path) -> DetectedPhoto | PhotoProblem:
        return _detected(path, masks.get(path), extractor, cache)

    # A photo for each thread, until there are fewer photos than threads.
    together = len(paths) - len(paths) % options.threads
    with opencv_threads(1), ThreadPoolExecutor(options.threads) as pool:
        results = list(progress.each(pool.map(one, paths[:together])))
    with opencv_threads(options.threads):
        results += list(progress.each(map(one, paths[together:])))
    photos, problems = _without_copies(results)
    cache.forget_others(STAGE, [photo.key for photo in photos])
    check_polarity([photo.kept for photo in photos if photo.info.path in masks])
    return photos, problems


def _detected(path: Path, mask: Path | None, extractor: Sift, cache: UnitCache) -> DetectedPhoto | PhotoProblem:
    """Features of one photo, found in the cache or in its pixels; or why it is not used."""
    bad_name = name_problem(path.name)
    if bad_name is not None:
        return PhotoProblem(path, f"{bad_name}; rename it", "not used")
    try:
        hashes = [file_hash(path), None if mask is None else file_hash(mask)]
        key = key_of(STAGE, code_version(), cv2.__version__, hashes, extractor.options)
        unit, info = cache.find(STAGE, key), read_photo_info(path)
    except InputError as error:
        return _unusable(path, error)
    if unit is not None:
        return DetectedPhoto(info, Features(**unit.arrays), key, mask=mask, **unit.facts)
    keep = None if mask is None else read_mask(mask, info)
    try:
        features, facts = _coarse_to_fine(extractor, info, keep)
    except InputError as error:
        return _unusable(path, error)
    facts |= {"kept": 1.0 if keep is None else float(keep.mean())}
    cache.keep(STAGE, key, Unit({f.name: getattr(features, f.name) for f in fields(Features)}, facts))
    return DetectedPhoto(info, features, key, mask=mask, **facts)


def _without_copies(
    results: Sequence[DetectedPhoto | PhotoProblem],
) -> tuple[list[DetectedPhoto], list[PhotoProblem]]:
    """The first of all photos with the same content, and the problems, to which its copies are added."""
    problems = [result for result in results if isinstance(result, PhotoProblem)]
    first: dict[str, DetectedPhoto] = {}
    for photo in (result for result in results if isinstance(result, DetectedPhoto)):
        if photo.key in first:
            reason = f"duplicate of {first[photo.key].info.path.name}, byte for byte"
            problems.append(PhotoProblem(photo.info.path, reason, "not used"))
        else:
            first[photo.key] = photo
    return list(first.values()), problems


def _unusable(path: Path, error: InputError) -> PhotoProblem:
    return PhotoProblem(path, str(error).removeprefix(f"{path}: "))


def _coarse_to_fine(
    extractor: Sift, info: PhotoInfo, keep: Bool[np.ndarray, "h w"] | None
) -> tuple[Features, dict[str, Any]]:
    """Features of a photo, its sharpness at the coarse size, and whether faint ones had to be taken.

    It is decoded no larger than each size needs.
    """

    def detect_at(size: int) -> tuple[Features, float]:
        image = read_photo(info.path, at_least_px=size).rgb
        grey = reduced_grey(image, size)
        return extractor.detect(grey, image, (info.width, info.height), keep), sharpness(grey)

    coarse, *finer = extractor.detection_sizes(info.width, info.height)
    features, sharp = detect_at(coarse)
    for size in finer:
        if not extractor.is_enough(features):
            features, _ = detect_at(size)
    scarce = extractor.is_scarce(features)
    if scarce:
        features = extractor.detect_faint(read_photo(info.path).rgb, (info.width, info.height), keep)
    return features, {"sharpness": sharp, "faint": scarce}


@contextmanager
def opencv_threads(threads: int) -> Iterator[None]:
    """How many threads OpenCV itself takes: one where every thread of ours has a photo of its own."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """How strong the finest detail of grey levels is, relative to its contrast: 0 for none.

    The root mean square of the Laplacian over the standard deviation of the grey levels. It compares photos of one
    scene; there is no value that is sharp for all.
    """
    contrast = float(grey.std())
    return float(cv2.Laplacian(grey, cv2.CV_32F).std()) / contrast if contrast > 0.0 else 0.0
