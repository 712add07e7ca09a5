"""Figures on disk: images beside an `index.json`, so that each command adds its part and the report can be rebuilt.

`OUT/figures/index.json` lists for every figure its part, section, title, caption, layout and files. A part ("mapping",
"field") belongs to one command: writing it again replaces it and leaves the others.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_bytes, write_json, write_text
from fieldstone.io.files.others import read_json
from fieldstone.report.raster import encode_jpeg
from fieldstone.report.theme import DARK, LIGHT, LIGHTBOX, Theme

logger = logging.getLogger(__name__)

FORMAT = 1
Layout = Literal["wide", "half"]
SAFE_FILE = re.compile(r"[a-z0-9][a-z0-9-]*\.(svg|jpg)")
"""Names that this module writes; an index that names anything else is not ours, and is not followed."""


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """A figure that can be drawn, and what the report says about it."""

    section: str
    """Key of the section it belongs to, see `summary.SECTIONS`."""
    key: str
    """Unique within a part: lower-case letters, digits and hyphens; becomes the file name."""
    title: str
    caption: str
    """What one should see in it, in one or two sentences."""
    draw: Callable[[Theme], str]
    """Gives the text of an SVG image."""
    on_dark: bool = False
    """Drawn once, on a dark ground, as suits the colours of photos; else once for a light and once for a dark page."""
    layout: Layout = "wide"


@dataclass(frozen=True)
class StoredFigure:
    """One entry of the index; `dark` is the file for a dark page, None if `light` serves both."""

    part: str
    section: str
    title: str
    caption: str
    layout: str
    light: str
    dark: str | None


@dataclass(frozen=True)
class FigureIndex:
    """All figures of a folder in the order in which they were written, and a small picture of each photo by name."""

    figures: tuple[StoredFigure, ...]
    thumbnails: dict[str, str]


def write_figures(
    folder: Path,
    part: str,
    figures: Iterable[ReportFigure],
    thumbnails: Mapping[str, UInt8[np.ndarray, "_ _ 3"]] | None = None,
) -> FigureIndex:
    """Draw the figures one by one and store them as one part of the folder; the other parts stay.

    Images are written first, the index last, and images that no index names any more are removed then: a reader
    always finds what the index promises.

    Args:
        part: Name of the part that this replaces; lower-case letters.
        thumbnails: Small pictures of photos by name; None keeps those that are stored.

    Raises:
        InputError: The folder cannot be made.
    """
    try:
        before = read_index(folder)
    except InputError as error:  # what a run has found is not lost over figures that can be drawn again
        logger.warning("%s; its figures are drawn anew", error)
        before = FigureIndex((), {})
    stored: list[StoredFigure] = []
    for figure in figures:
        stem = f"{part}-{figure.key}"
        light, dark = f"{stem}.svg", None if figure.on_dark else f"{stem}-dark.svg"
        write_text(folder / light, figure.draw(LIGHTBOX if figure.on_dark else LIGHT))
        if dark is not None:
            write_text(folder / dark, figure.draw(DARK))
        stored.append(StoredFigure(part, figure.section, figure.title, figure.caption, figure.layout, light, dark))
    pictures = before.thumbnails
    if thumbnails is not None:
        pictures = {}
        for number, (name, pixels) in enumerate(thumbnails.items()):
            pictures[name] = f"{part}-thumbnail-{number:04d}.jpg"
            write_bytes(folder / pictures[name], encode_jpeg(pixels))
    others = [f for f in before.figures if f.part != part]
    index = FigureIndex(tuple(sorted([*others, *stored], key=lambda f: f.part)), pictures)
    content = {"format": FORMAT, "figures": [asdict(f) for f in index.figures], "thumbnails": index.thumbnails}
    write_json(folder / "index.json", content)
    for name in _files(before) - _files(index):
        (folder / name).unlink(missing_ok=True)
    return index


def read_index(folder: Path) -> FigureIndex:
    """The index of a folder of figures; empty where there is none.

    Raises:
        InputError: The index is not one that `write_figures` wrote.
    """
    path = folder / "index.json"
    if not path.is_file():
        return FigureIndex((), {})
    content = read_json(path)
    try:
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}, this version reads {FORMAT}")
        figures = tuple(StoredFigure(**entry) for entry in content["figures"])
        index = FigureIndex(figures, dict(content["thumbnails"]))
        strange = [name for name in _files(index) if not (isinstance(name, str) and SAFE_FILE.fullmatch(name))]
        if strange:
            raise ValueError(f"names a file that no report writes: {strange[0]!r}")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not an index of figures ({error}); remove the folder and run again") from error
    return index


def _files(index: FigureIndex) -> set[str]:
    names = {name for f in index.figures for name in (f.light, f.dark) if name is not None}
    return names | set(index.thumbnails.values())
