"""Files that appear whole or not at all: written under a temporary name beside the target, then renamed."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone.errors import InputError

TEMPORARY_PREFIX = ".writing-"
"""Of temporary names; the process id follows."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder, with the same suffix; renamed to `path` if the block ends without error.

    The folder is made if it is missing. On an error, also Ctrl-C, the temporary file goes and `path` stays as it was.
    For a writer that chooses by suffix (images, video), and for one that streams.

    Raises:
        InputError: `path` is a folder, or its folder cannot be made.
    """
    _make_folder(path)
    descriptor, name = tempfile.mkstemp(prefix=_prefix(), suffix=path.suffix, dir=path.parent)
    os.close(descriptor)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes private files; a result has the permissions of any new file.
        temporary.chmod(0o666 & ~_umask())
        _flush_to_disk(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text with `\\n` line ends, whole or not at all."""
    write_bytes(path, text.encode())


def write_together(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Write files that only make sense together: all of them are on disk before the first is renamed."""
    _make_folder(folder / "file")
    temporaries: dict[str, Path] = {}
    try:
        for name in contents:
            descriptor, temporary = tempfile.mkstemp(prefix=_prefix(), dir=folder)
            temporaries[name] = Path(temporary)
            with os.fdopen(descriptor, "wb") as file:
                file.write(contents[name])
                file.flush()
                os.fsync(file.fileno())
            temporaries[name].chmod(0o666 & ~_umask())
        for name, temporary in temporaries.items():
            temporary.replace(folder / name)
    except BaseException:
        for temporary in temporaries.values():
            temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write strict JSON, indented, keys in the order given, floats exact.

    Dataclasses become objects, numpy arrays lists, numpy scalars numbers, paths strings.

    Raises:
        ValueError: A number is nan or infinite, which JSON cannot hold.
    """
    write_text(path, json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    """What `json` can write, of a value it does not know."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write a {type(value).__name__} as JSON")


def _make_folder(path: Path) -> None:
    if path.is_dir():
        raise InputError(f"{path}: cannot be written, a folder has that name; choose another output")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path.parent}: cannot be made, a file has that name; choose another output") from error


def _prefix() -> str:
    return f"{TEMPORARY_PREFIX}{os.getpid()}-"


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def _flush_to_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())
