"""Photos to features, each photo once."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import cv2

from fieldstone.errors import InputError
from fieldstone.features.sift import Sift
from fieldstone.io.masks import check_polarity, find_masks, read_mask
from fieldstone.io.photos import PhotoInfo, PhotoProblem, read_photo, read_photo_info
from fieldstone.io.workspace import Unit, Workspace, code_version, file_hash, key_of
from fieldstone.pipeline.matching_options import MatchingOptions
from fieldstone.scene.features import Features

STAGE = "features"


@dataclass(frozen=True, eq=False)
class SeenPhoto:
    """A photo whose features are known; its pixels are not kept."""

    info: PhotoInfo
    features: Features
    key: str
    """Hash of what the features depend on."""
    kept: float = 1.0
    """Share of the pixels that the mask keeps."""


def detect(
    paths: Sequence[Path], options: MatchingOptions, workspace: Workspace
) -> tuple[list[SeenPhoto], list[PhotoProblem]]:
    """Features of every readable photo, in the order of the paths, and the files that are none.

    Decoding and extraction release the interpreter lock. A photo is let go as soon as its features are known.

    Raises:
        InputError: The masks do not fit the photos.
    """
    extractor = Sift(options.sift)
    masks = {} if options.masks is None else find_masks(options.masks, paths)

    def one(path: Path) -> SeenPhoto | PhotoProblem:
        mask = masks.get(path)
        try:
            hashes = [file_hash(path), None if mask is None else file_hash(mask)]
            key = key_of(STAGE, code_version(), cv2.__version__, hashes, options.sift)
            unit = workspace.find(STAGE, key)
            if unit is not None:
                return SeenPhoto(read_photo_info(path), Features(**unit.arrays), key, unit.facts["kept"])
            photo = read_photo(path)
        except InputError as error:
            return PhotoProblem(path, str(error).removeprefix(f"{path}: "))
        keep = None if mask is None else read_mask(mask, photo.info)
        features, kept = extractor(photo.rgb, keep), 1.0 if keep is None else float(keep.mean())
        arrays = {f.name: getattr(features, f.name) for f in fields(Features)}
        workspace.keep(STAGE, key, Unit(arrays, {"kept": kept}))
        return SeenPhoto(photo.info, features, key, kept)

    with ThreadPoolExecutor(options.threads) as pool:
        results = list(pool.map(one, paths))
    seen = [result for result in results if isinstance(result, SeenPhoto)]
    workspace.forget_others(STAGE, [photo.key for photo in seen])
    check_polarity([photo.kept for photo in seen if photo.info.path in masks])
    return seen, [result for result in results if isinstance(result, PhotoProblem)]
