"""One opener of posed photos, whatever the format.

A new format is a reader, its test, and a line in `READERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from fieldstone.errors import InputError
from fieldstone.io.models.colmap import find_colmap_model
from fieldstone.io.posed.blender import is_blender_folder, read_blender
from fieldstone.io.posed.llff import is_llff_folder, read_llff
from fieldstone.io.posed.model_photos import read_model_photos
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.io.posed.transforms_json import find_transforms, read_transforms


class PhotoFolders(NamedTuple):
    """Where photos may lie that files name without a folder."""

    given: Path | None
    """By the user; counts more than anything else."""
    taken_from: Path | None
    """Where they were when the files were written."""


class PosedReader(NamedTuple):
    """A format of posed photos."""

    needs: str
    """What a source must hold, as a message says it."""
    recognises: Callable[[Path], bool]
    read: Callable[[Path, PhotoFolders], PosedScene]


def _transforms_in(source: Path) -> PosedScene:
    path = find_transforms(source)
    assert path is not None, "was recognised"
    return read_transforms(path)


READERS = (
    PosedReader("transforms_train.json (Blender)", is_blender_folder, lambda source, _: read_blender(source)),
    PosedReader(
        "sparse/0 (COLMAP; `fieldstone reconstruct` makes it from photos)",
        lambda source: find_colmap_model(source) is not None,
        lambda source, photos: read_model_photos(source, photos.given, taken_from=photos.taken_from),
    ),
    PosedReader("poses_bounds.npy (LLFF)", is_llff_folder, lambda source, photos: read_llff(source, photos.given)),
    PosedReader(
        "transforms.json (nerfstudio, instant-ngp)",
        lambda source: find_transforms(source) is not None,
        lambda source, _: _transforms_in(source),
    ),
)
"""In the order in which a source is tried."""


def open_posed_scene(source: Path, photos: Path | None = None, *, taken_from: Path | None = None) -> PosedScene:
    """The photos with cameras and poses of a folder, or of a transforms.json, and what is known of their scene.

    Args:
        photos: Folder with the photos of a COLMAP model or of LLFF poses, if they are not beside them.
        taken_from: Where the photos of a COLMAP model were when it was made.

    Raises:
        InputError: No posed photos in any format of `READERS`, a damaged file, or photos missing.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    for reader in READERS:
        if reader.recognises(source):
            return reader.read(source, PhotoFolders(photos, taken_from))
    raise InputError(f"{source}: no posed photos; needs one of: " + ", ".join(reader.needs for reader in READERS))
