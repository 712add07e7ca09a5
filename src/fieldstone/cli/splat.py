"""`fieldstone splat OUT`."""

from __future__ import annotations

import tyro

from fieldstone.cli.console import Source, plain_console, show_splats, shown_progress
from fieldstone.run.options import SurfaceOptions


def splat(source: Source, /, *, options: tyro.conf.OmitArgPrefixes[SurfaceOptions]) -> int:
    """Gaussian splats (PLY) of a trained fast field, and how much they look like it.

    Viewers of 3D Gaussian splatting open them.

    Args:
        source: Folder that `train` wrote; splats.ply and splats.json go there.
        options: Where the surface lies.
    """
    from fieldstone.run.field import open_field
    from fieldstone.run.folder import RunFolder

    console, folder = plain_console(), RunFolder(source)
    field = open_field(source)
    with folder.sole_writer(), shown_progress(console) as on_progress:
        found = field.splats(options, on_progress=on_progress)
        found.save(folder.splats)
        record = found.record(folder.splats.name)
        folder.write_splat_record(record)
    show_splats(console, record, folder.splats)
    return 0
