"""`fieldstone demo`."""

from __future__ import annotations

from pathlib import Path

import tyro

from fieldstone.cli.console import Out, plain_console, show_run, shown_progress
from fieldstone.run.options import DemoOptions


def demo(out: Out = Path("fieldstone-demo"), *, options: tyro.conf.OmitArgPrefixes[DemoOptions] = DemoOptions()) -> int:  # noqa: B008
    """The whole road on photos of a small house that the package makes itself, and what it misses the truth by.

    Args:
        out: Folder for photos, model, field, renders and report.html.
        options: How much of it.
    """
    from fieldstone.run.demo import run_demo

    console = plain_console()
    with shown_progress(console) as on_progress:
        made = run_demo(out, options, on_progress=on_progress)
    record = made.scene.record
    assert record is not None
    show_run(console, record, out)
    if made.field is None or made.field.metrics is None or record.truth is None:
        return 4
    truth, metrics = record.truth, made.field.metrics
    console.print(
        f"against the truth: rotation off by {truth.rotation_error_mean_deg:.3f} deg, position by "
        f"{1000 * truth.position_error_mean_m:.1f} mm on average; held-out views: PSNR {metrics.psnr:.2f} dB, "
        f"SSIM {metrics.ssim:.3f}\nopen {out / 'report.html'}",
        markup=False,
    )
    return 0
