"""Text and JSON files that others made: one way to read them, one way to say what is wrong with them.

Values are named by their path in the file, `frames[3].transform_matrix`, or by file and line. Of a key that stands
twice, the last one counts, as with most programs that write such files.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fieldstone.errors import InputError
from fieldstone.geometry.opengl import cam_from_world_of_gl
from fieldstone.geometry.rigid3 import Rigid3

MAX_JSON_BYTES = 1 << 29
"""Larger files are no scene descriptions: the largest known are some tens of megabytes."""

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
"""Python reads 1_000 and ١ as numbers as well; files do not mean them."""


def read_text(path: Path) -> str:
    """UTF-8 text, with or without a byte order mark.

    Raises:
        InputError: Not readable, or not UTF-8; with the byte.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}, byte {error.start}: not UTF-8 text; copy it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its name and permissions") from error


def read_json(path: Path, *, comments: bool = False) -> Any:
    """What a JSON file holds; numbers may be NaN, so they are taken through `finite_number`.

    Args:
        comments: Lines that only hold a // comment are passed over.

    Raises:
        InputError: Not readable, too large, not UTF-8 or not JSON; with the line.
    """
    if path.is_file() and path.stat().st_size > MAX_JSON_BYTES:
        raise InputError(f"{path}: more than {MAX_JSON_BYTES >> 20} MiB; is it the right file?")
    text = read_text(path)
    if comments:
        text = "\n".join("" if line.lstrip().startswith("//") else line for line in text.split("\n"))
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}: not valid JSON ({error.msg}); copy it again") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: not valid JSON (nested too deeply, or a number too long); copy it again") from error


def finite_number(value: Any, where: str) -> float:
    """A number of a JSON file.

    Args:
        where: File and path of the value, as the message names it.

    Raises:
        InputError: It is none, or not finite.
    """
    try:
        if not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value):
            return float(value)
    except OverflowError:
        pass
    raise InputError(f"{where} must be a finite number, got {short(value)}; correct the file")


def camera_pose(value: Any, where: str) -> Rigid3:
    """`cam_from_world` of a matrix world_from_camera with OpenGL axes: four rows, or sixteen numbers.

    Raises:
        InputError: No finite rigid motion; the message says what is wrong.
    """
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where} is no matrix of numbers; correct or remove it") from error
    try:
        return cam_from_world_of_gl(matrix.reshape(4, 4) if matrix.shape == (16,) else matrix)
    except ValueError as error:
        raise InputError(f"{where} is no camera pose: {error}; correct or remove it") from error


def finite_word(word: str, where: str) -> float:
    """A number of a text file.

    Args:
        where: File and line, as the message names it.

    Raises:
        InputError: It is none, or not finite.
    """
    if not is_finite_word(word):
        raise InputError(f"{where}: {word[:40]!r} is not a finite number; correct or remove the line")
    return float(word)


def is_finite_word(word: str) -> bool:
    """Whether a word of a text file is a finite number."""
    return NUMBER.fullmatch(word) is not None and math.isfinite(float(word))


def finite_words(path: Path, lines: Sequence[Sequence[str]], numbers: Sequence[int]) -> Float[np.ndarray, "n"]:
    """All words of some lines as numbers, in one go; a bad one is only searched for if there is one.

    Args:
        numbers: Of the lines in the file.

    Raises:
        InputError: A word is no finite number; with its line.
    """
    flat = [word for words in lines for word in words]
    try:
        values = np.array([float(word) for word in flat], dtype=np.float64)
    except ValueError:
        values = np.array([np.nan])
    text = "".join(flat)
    if np.isfinite(values).all() and "_" not in text and text.isascii():
        return values
    return np.array(
        [
            finite_word(word, f"{path}, line {number}")
            for words, number in zip(lines, numbers, strict=True)
            for word in words
        ]
    )


def short(value: Any) -> str:
    """The beginning of a value, for messages."""
    return repr(value)[:40]
