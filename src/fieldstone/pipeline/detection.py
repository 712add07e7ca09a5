"""Photos to features, each photo once."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import cv2

from fieldstone import __version__
from fieldstone.errors import InputError
from fieldstone.features.sift import Sift
from fieldstone.io.photos import PhotoInfo, PhotoProblem, read_photo, read_photo_info
from fieldstone.io.workspace import Unit, Workspace, file_hash, key_of
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


def detect(
    paths: Sequence[Path], options: MatchingOptions, workspace: Workspace
) -> tuple[list[SeenPhoto], list[PhotoProblem]]:
    """Features of every readable photo, in the order of the paths, and the files that are none.

    Decoding and extraction release the interpreter lock. A photo is let go as soon as its features are known.
    """
    extractor = Sift(options.sift)

    def one(path: Path) -> SeenPhoto | PhotoProblem:
        try:
            key = key_of(STAGE, __version__, cv2.__version__, file_hash(path), options.sift)
            unit = workspace.find(STAGE, key)
            if unit is not None:
                return SeenPhoto(read_photo_info(path), _unpack(unit), key)
            photo = read_photo(path)
        except InputError as error:
            return PhotoProblem(path, str(error).removeprefix(f"{path}: "))
        features = extractor(photo.rgb)
        workspace.keep(STAGE, key, _pack(features))
        return SeenPhoto(photo.info, features, key)

    with ThreadPoolExecutor(options.threads) as pool:
        results = list(pool.map(one, paths))
    seen = [result for result in results if isinstance(result, SeenPhoto)]
    workspace.forget_others(STAGE, [photo.key for photo in seen])
    return seen, [result for result in results if isinstance(result, PhotoProblem)]


def _pack(features: Features) -> Unit:
    return Unit({f.name: getattr(features, f.name) for f in fields(Features)})


def _unpack(unit: Unit) -> Features:
    return Features(**unit.arrays)
