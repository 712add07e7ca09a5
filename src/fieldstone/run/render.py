"""A trained field to a film or to images along a camera path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fieldstone.errors import InputError
from fieldstone.progress import OnProgress, silent
from fieldstone.run.field import Field, open_field
from fieldstone.run.folder import RunFolder
from fieldstone.run.options import RenderOptions


def render(
    field: Field | str | Path,
    options: RenderOptions | None = None,
    *,
    to: str | Path | None = None,
    on_progress: OnProgress = silent,
    **settings: Any,
) -> Path:
    """A film of a trained field, written.

    Args:
        field: A field, or the folder that `train` left it in.
        options: None: those that `settings` give.
        to: The film (.mp4, .gif), or without a suffix a folder of images. None: renders/PATH.FORMAT in the folder of
            the field, PATH_depth and so on for what is not colour.
        settings: Fields of `RenderOptions`, where no options are given.

    Returns:
        The file or folder written.

    Raises:
        InputError: No usable checkpoint, no such path, nowhere to write, or another process writes there.
    """
    options = options or RenderOptions(**settings)
    if isinstance(field, Field):
        if to is None:
            raise InputError("a film of a field in memory needs a place: give `to`")
        return field.film(options).save(to, on_progress)
    out = RunFolder(Path(field))
    film = open_field(field).film(options)
    if to is not None:
        return film.save(to, on_progress)
    with out.sole_writer():
        return film.save(out.film(film.name, "" if options.format == "png" else f".{options.format}"), on_progress)
