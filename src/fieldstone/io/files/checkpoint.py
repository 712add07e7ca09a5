"""Checkpoints of fields: named arrays and a JSON header in one safetensors file, whole or not at all.

A CRC covers arrays and header, so that a file damaged on disk is refused instead of rendered.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_bytes

HEADER_KEY = "fieldstone"
FORMAT = 1


def write_checkpoint(path: Path, tensors: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write arrays and a header of plain JSON values; the same content always gives the same bytes."""
    arrays = {name: np.asarray(tensors[name], order="C") for name in sorted(tensors)}
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    content = {"format": FORMAT, "crc32": _crc32(arrays, text), "header": text}
    write_bytes(path, save(arrays, metadata={HEADER_KEY: json.dumps(content)}))


def read_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and header of a checkpoint.

    Raises:
        InputError: Missing, truncated, damaged, or no checkpoint of this program.
    """
    if not path.is_file():
        raise InputError(f"{path}: no checkpoint here; run `fieldstone train` first")
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            # `keys` is a method of a file handle, not of a dict.
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: damaged or truncated checkpoint ({error}); delete it and train again") from error
    try:
        content = json.loads(metadata[HEADER_KEY])
        found_format, crc32, text = content["format"], content["crc32"], content["header"]
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: a safetensors file, but no fieldstone checkpoint; choose another folder") from error
    if found_format != FORMAT:
        raise InputError(f"{path}: checkpoint format {found_format}, this version reads {FORMAT}; train again")
    if crc32 != _crc32(arrays, text):
        raise InputError(f"{path}: damaged checkpoint, it does not match its checksum; delete it and train again")
    return arrays, json.loads(text)


def _crc32(arrays: Mapping[str, np.ndarray], text: str) -> int:
    value = zlib.crc32(text.encode())
    for name in sorted(arrays):
        array = np.asarray(arrays[name], order="C")
        value = zlib.crc32(f"{name} {array.dtype.str} {array.shape}".encode(), value)
        value = zlib.crc32(array.reshape(-1).view(np.uint8).data, value)
    return value
