"""Photos to features, each photo once."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
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
from fieldstone.io.images.exif import ExifFacts
from fieldstone.io.images.masks import check_polarity, find_masks, inside_opaque, on_mean_colour, read_mask
from fieldstone.io.images.photos import PhotoInfo, PhotoProblem, read_photo, read_photo_info
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.scene.features import Features

STAGE = "features"
PANORAMA = "a panorama, as its XMP says: no camera that takes photos in a plane or through a fisheye sees so"


@dataclass(frozen=True, eq=False)
class DetectedPhoto:
    """A photo whose features are known; its pixels are not kept."""

    name: str
    """Its path below the folder of the photos."""
    info: PhotoInfo
    features: Features
    key: str
    """Hash of what the features depend on."""
    kept: float = 1.0
    """Share of the pixels that its masks keep."""
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
        return self.pixels_to_search(None)

    def pixels_to_search(
        self, at_least_px: int | None
    ) -> tuple[UInt8[np.ndarray, "_ _ 3"], Bool[np.ndarray, "h w"] | None]:
        """`pixels`, the colours perhaps of a smaller picture, see `read_photo`."""
        photo = read_photo(self.info.path, at_least_px=at_least_px)
        masks = [] if self.mask is None else [read_mask(self.mask, self.info)]
        if photo.alpha is not None and (opaque := inside_opaque(photo)) is not None:
            masks.append(opaque)
        if self.static_cells is not None:
            size = self.info.width, self.info.height
            still = cv2.resize(self.static_cells.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
            masks.append(still == 0)
        return on_mean_colour(photo), np.logical_and.reduce(masks) if masks else None

    def without(self, static: Bool[np.ndarray, "n"], cells: Bool[np.ndarray, "_ _"] | None) -> DetectedPhoto:
        """The photo without the features that do not move with the scene, and without cells in which nothing does."""
        key = key_of(self.key, np.packbits(static).tobytes().hex())
        if cells is not None and self.static_cells is not None:
            cells = cells | self.static_cells
        return replace(
            self, features=self.features[~static], key=key, static_cells=self.static_cells if cells is None else cells
        )


def detect(
    paths: Mapping[str, Path],
    options: MatchingOptions,
    cache: UnitCache,
    on_progress: OnProgress = silent,
) -> tuple[list[DetectedPhoto], list[PhotoProblem]]:
    """Features of every readable photo, in the order given, and the files that are not used.

    Of several photos with the same content only the first is used: the others would count its observations twice.
    Decoding and extraction release the interpreter lock. A photo is let go as soon as its features are known.

    Args:
        paths: Photos by name.

    Raises:
        InputError: The masks do not fit the photos.
    """
    extractor = Sift(options.sift)
    masks = {} if options.masks is None else find_masks(options.masks, paths)
    progress = StageProgress(on_progress, "finding features", len(paths))

    def one(name: str) -> DetectedPhoto | PhotoProblem:
        return _detected(name, paths[name], masks.get(paths[name]), extractor, cache)

    with opencv_threads(1), ThreadPoolExecutor(options.threads) as pool:
        results = list(progress.each(pool.map(one, paths)))
    photos, problems = _without_copies(results)
    cache.forget_others(STAGE, [photo.key for photo in photos])
    check_polarity([photo.kept for photo in photos if photo.info.path in masks])
    return photos, problems


def _detected(
    name: str, path: Path, mask: Path | None, extractor: Sift, cache: UnitCache
) -> DetectedPhoto | PhotoProblem:
    """Features of one photo, found in the cache or in its pixels; or why it is not used."""
    bad_name = name_problem(name)
    if bad_name is not None:
        return PhotoProblem(path, f"{bad_name}; rename it", "not used")
    try:
        hashes = [file_hash(path), None if mask is None else file_hash(mask)]
        key = key_of(STAGE, code_version(), cv2.__version__, hashes, extractor.options)
        unit, info = cache.find(STAGE, key), read_photo_info(path)
    except InputError as error:
        return _unusable(path, error)
    if info.panorama:
        return PhotoProblem(path, PANORAMA, "not used")
    photo = DetectedPhoto(name, info, Features.none(), key, mask=mask)
    if unit is not None:
        return replace(photo, features=Features(**unit.arrays), **unit.facts)
    try:
        return searched(photo, extractor, cache)
    except InputError as error:
        return _unusable(path, error)


def searched(photo: DetectedPhoto, extractor: Sift, cache: UnitCache) -> DetectedPhoto:
    """The photo with the features that are found in what its masks keep; they go into the cache under its key."""
    features, facts = _coarse_to_fine(extractor, photo)
    cache.keep(STAGE, photo.key, Unit({f.name: getattr(features, f.name) for f in fields(Features)}, facts))
    return replace(photo, features=features, **facts)


def _without_copies(
    results: Sequence[DetectedPhoto | PhotoProblem],
) -> tuple[list[DetectedPhoto], list[PhotoProblem]]:
    """One of all photos with the same content, and the problems, to which its copies are added.

    Copies whose files differ in what they say of the photo, and not in its pixels, have the same features: the one
    stays that says the same as most photos. If none says what any other photo does, none is believed.
    """
    problems = [result for result in results if isinstance(result, PhotoProblem)]
    photos = [result for result in results if isinstance(result, DetectedPhoto)]
    said = Counter(replace(photo.info.exif, gps=None) for photo in photos)

    def agreeing(k: int) -> int:
        return said[replace(photos[k].info.exif, gps=None)]

    copies: dict[str, list[int]] = {}
    for k, photo in enumerate(photos):
        copies.setdefault(_content_of(photo), []).append(k)
    kept: dict[int, DetectedPhoto] = {}
    for same in copies.values():
        chosen = max(same, key=lambda k: (agreeing(k), -k))
        stays = photos[chosen]
        if len({replace(photos[k].info.exif, gps=None) for k in same}) > 1 and agreeing(chosen) == 1:
            stays = replace(stays, info=replace(stays.info, exif=ExifFacts(gps=stays.info.exif.gps)))
        kept[chosen] = stays
        for k in (k for k in same if k != chosen):
            how = "byte for byte" if photos[k].key == stays.key else "pixel for pixel, though the files differ"
            reason = f"duplicate of {stays.name}, {how}"
            problems.append(PhotoProblem(photos[k].info.path, reason, "not used"))
    return [kept[k] for k in sorted(kept)], problems


def _content_of(photo: DetectedPhoto) -> str:
    """A hash that photos with the same pixels share; of photos that show nothing, that of their files."""
    features = photo.features
    if not len(features):
        return photo.key
    arrays = [np.ascontiguousarray(array).tobytes() for array in (features.keypoints, features.descriptors)]
    content = hashlib.blake2b(b"".join(arrays), digest_size=16).hexdigest()
    return f"{photo.info.width} x {photo.info.height}, {content}"


def _unusable(path: Path, error: InputError) -> PhotoProblem:
    return PhotoProblem(path, str(error).removeprefix(f"{path}: "))


def _coarse_to_fine(extractor: Sift, photo: DetectedPhoto) -> tuple[Features, dict[str, Any]]:
    """Features of a photo, and other facts: see `DetectedPhoto`.

    It is decoded no larger than each size needs.
    """
    size = photo.info.width, photo.info.height
    coarse, *finer = extractor.detection_sizes(*size)
    image, keep = photo.pixels_to_search(coarse)
    grey = reduced_grey(image, coarse)
    features, sharp = extractor.detect(grey, image, size, keep), sharpness(grey)
    for fine in finer:
        if not extractor.is_enough(features):
            image, keep = photo.pixels_to_search(fine)
            features = extractor.detect(reduced_grey(image, fine), image, size, keep)
    scarce = extractor.is_scarce(features)
    if scarce:
        image, keep = photo.pixels_to_search(None)
        features = extractor.detect_faint(image, size, keep)
    kept = 1.0 if keep is None else float(keep.mean())
    return features, {"sharpness": sharp, "faint": scarce, "kept": kept}


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
