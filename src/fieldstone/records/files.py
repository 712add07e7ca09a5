"""Records as JSON files, and back with every field checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fieldstone.errors import InputError

R = TypeVar("R")


def to_json(record: Any) -> dict[str, Any]:
    """Plain JSON values of a record."""
    return msgspec.to_builtins(record)


def from_json(kind: type[R], value: Any, where: str) -> R:
    """The record that plain JSON values hold; keys that it does not know are passed over.

    Args:
        where: The file, as the message names it.

    Raises:
        InputError: A field is missing or is of another type; with its path.
    """
    try:
        return msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: not what this version writes ({error}); run the command again") from error


def read_record(kind: type[R], path: Path) -> R:
    """The record in a JSON file.

    Raises:
        InputError: Not readable, not JSON, or not such a record.
    """
    return _decoded(kind, path)


def read_records(kind: type[R], path: Path) -> tuple[R, ...]:
    """The list of records in a JSON file.

    Raises:
        InputError: Not readable, not JSON, or not a list of such records.
    """
    return _decoded(tuple[kind, ...], path)


def _decoded(kind: Any, path: Path) -> Any:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: not what this version writes ({error}); run the command again") from error
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run the command again") from error
