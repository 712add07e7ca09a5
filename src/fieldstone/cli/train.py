"""`fieldstone train SCENE -o OUT`."""

from __future__ import annotations

import tyro

from fieldstone.cli.console import Out, Source, plain_console, show_metrics, shown_progress
from fieldstone.run.options import TrainOptions


def train(source: Source, /, out: Out, options: tyro.conf.OmitArgPrefixes[TrainOptions]) -> int:
    """A radiance field from posed photos, and its held-out views measured.

    Run it again to go on after a stop.

    Args:
        source: Folder that `reconstruct` wrote, COLMAP model with its images, Blender or LLFF folder, or
            transforms.json of nerfstudio or instant-ngp.
        out: Folder for the result: checkpoint.safetensors, metrics.json, curve.json, renders/test.
        options: How posed photos become a field.
    """
    from fieldstone.run.train import train as run

    console = plain_console()
    with shown_progress(console) as on_progress:
        field = run(source, options, keep_in=out, on_progress=on_progress)
    assert field.metrics is not None
    show_metrics(console, field.metrics, out)
    return 0
