"""Point clouds as PLY: read in any of its encodings, written in binary with all digits.

Source:
    Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_bytes
from fieldstone.io.files.binary import bytes_left, read_array, refuse_at
from fieldstone.scene.reconstruction import Points

TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_BYTES = 1 << 20
NO_COLOR = 128
"""Grey of points whose file has no colours."""
RECORD = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])


@dataclass(frozen=True)
class _Property:
    """A number, or a list if `count_type` is given."""

    name: str
    dtype: np.dtype
    count_dtype: np.dtype | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    @property
    def has_lists(self) -> bool:
        """Records of different lengths: they have to be walked one by one."""
        return any(p.count_dtype is not None for p in self.properties)

    @property
    def min_size(self) -> int:
        """Fewest bytes of a record."""
        return sum((p.count_dtype or p.dtype).itemsize for p in self.properties)


def read_points(path: Path) -> Points:
    """The vertices of a PLY file (ASCII, little or big endian), coordinates as they stand; the rest is passed over.

    Colours: `red green blue` or `diffuse_red ...`, 8 or 16 bits or floats; grey where there are none.

    Raises:
        InputError: Not a PLY file, damaged, without x y z, or a coordinate is not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a point cloud in PLY format")
    file = io.BytesIO(path.read_bytes())
    encoding, elements = _read_header(file, path)
    for element in elements:
        columns = (_read_ascii if encoding == "ascii" else _read_binary)(file, element, path)
        if element.name == "vertex":
            return _points_from_columns(columns, path)
    raise InputError(f"{path}: no vertex element; it holds {', '.join(e.name for e in elements) or 'nothing'}")


def write_points(points: Points, path: Path) -> None:
    """Write world points and sRGB colours, binary little endian, double precision, whole or not at all."""
    header = ["ply", "format binary_little_endian 1.0", "comment written by fieldstone"]
    header += [f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {color}" for color in ("red", "green", "blue")]
    records = np.empty(len(points), RECORD)
    records["xyz"], records["rgb"] = points.xyz, points.rgb
    write_bytes(path, "\n".join([*header, "end_header", ""]).encode() + records.tobytes())


def _read_header(file: io.BytesIO, path: Path) -> tuple[str, list[_Element]]:
    """Encoding and elements; the cursor ends at the first byte of the data."""
    if file.readline(8).rstrip() != b"ply":
        raise InputError(f"{path}: not a PLY file, the first line must be `ply`")
    encoding, elements = "", []
    number = 1
    while file.tell() < MAX_HEADER_BYTES and (line := file.readline(MAX_HEADER_BYTES)):
        number += 1
        words = line.decode("ascii", errors="replace").split()
        if words == ["end_header"]:
            if not encoding:
                raise InputError(f"{path}, line {number}: the header has no format line")
            return encoding, elements
        try:
            if words and words[0] == "format":
                encoding = words[1]
                if encoding not in BYTE_ORDERS:
                    raise ValueError(f"unknown format {encoding[:40]!r}")
            elif words and words[0] == "element":
                elements.append(_Element(words[1], _element_count(words[2]), ()))
            elif words and words[0] == "property":
                last = elements.pop()
                prop = _parse_property(words, BYTE_ORDERS[encoding])
                if prop.name in [p.name for p in last.properties]:
                    raise ValueError(f"property {prop.name!r} is there twice")
                elements.append(_Element(last.name, last.count, (*last.properties, prop)))
            elif words and words[0] not in ("comment", "obj_info"):
                raise ValueError(f"unknown keyword {words[0][:40]!r}")
        except (ValueError, IndexError, KeyError) as error:
            why = error if isinstance(error, ValueError) else "a word is missing or unknown"
            raise InputError(f"{path}, line {number}: damaged header ({why})") from error
    raise InputError(f"{path}: the header does not end; the file is truncated")


def _element_count(word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 19):
        raise ValueError(f"{word[:40]!r} is not a number of elements")
    return int(word)


def _parse_property(words: list[str], order: str) -> _Property:
    """`property TYPE NAME` or `property list COUNT_TYPE TYPE NAME`."""
    if words[1] != "list":
        return _Property(words[2], np.dtype(order + TYPES[words[1]]))
    count_dtype = np.dtype(order + TYPES[words[2]])
    if count_dtype.kind == "f":
        raise ValueError("the length of a list must be a whole number")
    return _Property(words[4], np.dtype(order + TYPES[words[3]]), count_dtype)


def _read_binary(file: io.BytesIO, element: _Element, path: Path) -> dict[str, np.ndarray]:
    """Columns of the element's plain properties; lists are passed over."""
    if element.count * element.min_size > bytes_left(file):
        why = f"{element.count} records of {element.name!r} do not fit into the {bytes_left(file)} bytes left"
        refuse_at(path, file.tell(), f"{why}; the file is truncated")
    plain = [p for p in element.properties if p.count_dtype is None]
    if not element.has_lists:
        records = read_array(file, np.dtype([(p.name, p.dtype) for p in plain]), element.count, path, element.name)
        return {p.name: records[p.name].copy() for p in plain}
    columns = {p.name: np.empty(element.count, p.dtype) for p in plain}
    for k in range(element.count):
        for p in element.properties:
            if p.count_dtype is None:
                columns[p.name][k] = read_array(file, p.dtype, 1, path, element.name)[0]
                continue
            start = file.tell()
            length = int(read_array(file, p.count_dtype, 1, path, f"length of {p.name}")[0])
            if not 0 <= length * p.dtype.itemsize <= bytes_left(file):
                refuse_at(path, start, f"a list of {length} values does not fit into the rest of the file")
            file.seek(length * p.dtype.itemsize, io.SEEK_CUR)
    return columns


def _read_ascii(file: io.BytesIO, element: _Element, path: Path) -> dict[str, np.ndarray]:
    """The same from text, one record a line."""
    plain = [p for p in element.properties if p.count_dtype is None]
    if element.count * max(1, 2 * len(element.properties)) > bytes_left(file) + 1:
        why = f"{element.count} records of {element.name!r} do not fit into the {bytes_left(file)} bytes left"
        refuse_at(path, file.tell(), f"{why}; the file is truncated")
    columns = {p.name: np.empty(element.count) for p in plain}
    for k in range(element.count):
        start = file.tell()
        words = file.readline().split()
        try:
            at = 0
            for p in element.properties:
                if p.count_dtype is None:
                    columns[p.name][k] = float(words[at])
                    at += 1
                else:
                    at += 1 + int(words[at])
            if at != len(words):
                raise ValueError(f"{len(words)} values instead of {at}")
        except (ValueError, IndexError) as error:
            refuse_at(path, start, f"record {k} of {element.name!r} cannot be read ({_one_line(error)})")
    with np.errstate(invalid="ignore", over="ignore"):
        return {p.name: columns[p.name].astype(p.dtype) for p in plain}


def _points_from_columns(columns: dict[str, np.ndarray], path: Path) -> Points:
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise InputError(f"{path}: vertices have no {' '.join(missing)}; they have {', '.join(columns) or 'nothing'}")
    xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    not_finite = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if len(not_finite):
        raise InputError(f"{path}: vertex {not_finite[0]} is not finite (and {len(not_finite) - 1} more); remove it")
    for prefix in ("", "diffuse_"):
        names = [f"{prefix}{color}" for color in ("red", "green", "blue")]
        if all(name in columns for name in names):
            return Points(xyz, np.stack([_eight_bit(columns[name]) for name in names], axis=1))
    return Points(xyz, np.full(xyz.shape, NO_COLOR, dtype=np.uint8))


def _eight_bit(channel: np.ndarray) -> np.ndarray:
    """Integers of 16 bits keep the upper 8; fractions are in [0, 1]; all else is in 0..255 already."""
    if channel.dtype.kind == "f":
        return np.clip(np.round(np.nan_to_num(channel) * 255), 0, 255).astype(np.uint8)
    if channel.dtype.itemsize == 2:
        channel = channel >> 8
    return np.clip(channel, 0, 255).astype(np.uint8)


def _one_line(error: Exception) -> str:
    return str(error).splitlines()[0][:80] if str(error) else type(error).__name__
