"""`fieldstone mesh OUT`."""

from __future__ import annotations

import tyro

from fieldstone.cli.console import Source, plain_console, show_mesh, shown_progress
from fieldstone.run.options import MeshFormat, SurfaceOptions


def mesh(source: Source, /, *, format: MeshFormat = "ply", options: tyro.conf.OmitArgPrefixes[SurfaceOptions]) -> int:
    """A coloured mesh of a trained fast field, and how well it agrees with the field.

    What floats about is left out.

    Args:
        source: Folder that `train` wrote; mesh.FORMAT and mesh.json go there.
        format: ply, obj, or glb (y up).
        options: Where the surface lies.
    """
    from fieldstone.run.field import open_field
    from fieldstone.run.folder import RunFolder

    console, folder = plain_console(), RunFolder(source)
    field, path = open_field(source), folder.mesh(f".{format}")
    with folder.sole_writer(), shown_progress(console) as on_progress:
        found = field.mesh(options, on_progress=on_progress)
        found.save(path)
        record = found.record(path.name)
        folder.write_mesh_record(record)
    show_mesh(console, record, path)
    return 0
