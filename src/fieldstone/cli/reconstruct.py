"""`fieldstone reconstruct PHOTOS -o OUT`."""

from __future__ import annotations

import tyro

from fieldstone.cli.console import Out, Source, plain_console, show_run, shown_progress
from fieldstone.run.reconstruct_options import ReconstructOptions


def reconstruct(source: Source, /, out: Out, options: tyro.conf.OmitArgPrefixes[ReconstructOptions]) -> int:
    """Camera poses and a point cloud from photos, or from given matches.

    Run it again to go on after a stop.

    Args:
        source: Folder with photos; or with calibration.txt, matching*.txt and the photos.
        out: Folder for the result: sparse/0 (COLMAP), points.ply, run.json, report.html.
        options: How photos become a scene.
    """
    from fieldstone.run.reconstruct import reconstruct as run

    console = plain_console()
    with shown_progress(console) as on_progress:
        scene = run(source, options, keep_in=out, on_progress=on_progress)
    assert scene.record is not None
    show_run(console, scene.record, out)
    return 0 if scene.summary.registered >= 2 else 4
