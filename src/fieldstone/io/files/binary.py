"""Bounded reading of binary records: a count is compared with the bytes that are left before anything is allocated."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import NoReturn

import numpy as np

from fieldstone.errors import InputError


def bytes_left(file: io.BytesIO) -> int:
    """Bytes between the cursor and the end."""
    return file.getbuffer().nbytes - file.tell()


def read_struct(file: io.BytesIO, layout: struct.Struct, path: Path, what: str) -> tuple:
    """The fields of one record.

    Raises:
        InputError: The file ends before the record does.
    """
    if bytes_left(file) < layout.size:
        refuse_at(path, file.tell(), f"the file ends inside {what}; it is truncated, copy or write it again")
    return layout.unpack(file.read(layout.size))


def read_count(file: io.BytesIO, layout: struct.Struct, item_size: int, path: Path, what: str) -> int:
    """A count of items of at least `item_size` bytes each, which the rest of the file can hold.

    Raises:
        InputError: The file is too short for the count, or for that many items.
    """
    start = file.tell()
    (count,) = read_struct(file, layout, path, f"the number of {what}")
    if count * item_size > bytes_left(file):
        refuse_at(path, start, f"{count} {what} do not fit into the {bytes_left(file)} bytes left; the file is damaged")
    return count


def read_array(file: io.BytesIO, dtype: np.dtype, count: int, path: Path, what: str) -> np.ndarray:
    """`count` records as a copy.

    Raises:
        InputError: The file ends before.
    """
    if count * dtype.itemsize > bytes_left(file):
        refuse_at(path, file.tell(), f"{count} {what} do not fit into the {bytes_left(file)} bytes left")
    return np.frombuffer(file.read(count * dtype.itemsize), dtype).copy()


def refuse_at(path: Path, byte: int, why: str) -> NoReturn:
    """Raise the InputError that names file and byte."""
    raise InputError(f"{path}, byte {byte}: {why}")
