"""What the terminal shows: progress while a verb runs, and its result from the records."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from fieldstone.progress import OnProgress
from fieldstone.progress import Progress as Event
from fieldstone.records.field import FieldMetrics
from fieldstone.records.mapping import Grade, RunRecord
from fieldstone.records.shapes import MeshRecord, SplatRecord

Source = Annotated[Path, tyro.conf.Positional]
"""The first argument of a verb."""
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
"""Where a verb writes."""


def plain_console() -> Console:
    """The terminal, without colours that rich would guess."""
    return Console(highlight=False)


@contextmanager
def shown_progress(console: Console) -> Iterator[OnProgress]:
    """A line for the stage that runs: its name, a bar where the number of its units is known, and what it says."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[detail]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as display:
        task: TaskID | None = None
        stage = None

        def show(event: Event) -> None:
            nonlocal task, stage
            if task is None or event.stage != stage:
                if task is not None:
                    display.remove_task(task)
                task, stage = display.add_task(event.stage, total=event.total, detail=event.detail), event.stage
            display.update(task, completed=event.done, total=event.total, detail=event.detail)

        yield show


def show_run(console: Console, record: RunRecord, out: Path) -> None:
    """The error table, the drops, and one line for every photo that was left out."""
    table = Table("stage", "photo", *("points", "behind", "mean px", "median px", "RMS px"), box=None)
    for column in table.columns[2:]:
        column.justify = "right"
    for row in record.table:
        errors = ("-" if error is None else f"{error:.3f}" for error in (row.mean_px, row.median_px, row.rms_px))
        table.add_row(row.stage, row.photo, str(row.points), str(row.behind), *errors)
    console.print(table)
    for drop in record.drops:
        console.print(f"dropped {drop.observations:6d}  {drop.stage}: {drop.reason}", markup=False)
    for note in record.notes:
        console.print(note, markup=False)
    for photo in record.photos:
        if not photo.registered:
            console.print(f"{photo.name}: {photo.verdict}", markup=False, style="yellow")
    summary = record.summary
    if summary.mean_px is None:
        console.print("no model: no photo could be registered", style="red")
    else:
        console.print(
            f"{summary.registered} of {summary.photos} photos, {summary.points} points, "
            f"{summary.observations} observations, mean error {summary.mean_px:.3f} px -> {out}",
            markup=False,
        )
    if record.grade is not None:
        show_grade(console, record.grade)


GRADE_STYLE = {"good": "green", "weak": "yellow", "doubtful": "red"}


def show_grade(console: Console, grade: Grade) -> None:
    """The grade, and a line for every reason with its advice."""
    console.print(f"grade: {grade.word}", markup=False, style=GRADE_STYLE[grade.word])
    for reason in grade.reasons:
        console.print(
            f"  {reason.word}: {reason.reason}; {reason.advice}", markup=False, style=GRADE_STYLE[reason.word]
        )


def show_metrics(console: Console, metrics: FieldMetrics, out: Path) -> None:
    """Steps, time, and how alike held-out views are."""
    done = f"{metrics.steps} steps in {metrics.seconds:.0f} s"
    if metrics.psnr is None:
        console.print(f"{done}; no photo was held out, so nothing is measured -> {out}", markup=False)
    else:
        console.print(
            f"{done}; {len(metrics.views)} held-out views: PSNR {metrics.psnr:.2f} dB, "
            f"SSIM {metrics.ssim:.3f} -> {out}",
            markup=False,
        )


def show_mesh(console: Console, record: MeshRecord, path: Path) -> None:
    """The size of a mesh and its agreement with the field."""
    depth = record.depth_error_median_percent
    console.print(
        f"{record.vertices} vertices, {record.faces} faces, {record.floaters_removed} floaters removed; "
        f"silhouettes agree with the field by {100 * record.silhouette_iou:.1f} % (IoU), depths "
        f"{'nowhere comparable' if depth is None else f'to {depth:.2f} % (median)'} -> {path}",
        markup=False,
    )


def show_splats(console: Console, record: SplatRecord, path: Path) -> None:
    """How many splats there are, and how much they look like the field."""
    found = record.psnr_to_field
    console.print(
        f"{record.splats} splats; against the field: "
        f"{'not comparable' if found is None else f'PSNR {found:.2f} dB'} -> {path}",
        markup=False,
    )
