"""`fieldstone render OUT`."""

from __future__ import annotations

import tyro

from fieldstone.cli.console import Source, plain_console, shown_progress
from fieldstone.run.options import RenderOptions


def render(source: Source, /, *, options: tyro.conf.OmitArgPrefixes[RenderOptions]) -> int:
    """A film of a trained field.

    Args:
        source: Folder that `train` wrote; the film goes to its folder renders.
        options: What it shows.
    """
    from fieldstone.run.render import render as run

    console = plain_console()
    with shown_progress(console) as on_progress:
        target = run(source, options, on_progress=on_progress)
    console.print(f"rendered -> {target}", markup=False)
    return 0
