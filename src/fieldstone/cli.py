"""`fieldstone VERB ...`: verbs are typed functions; help and types come from their signatures.

Exit codes: 0 good, 2 usage, 3 bad input, 4 result below what was asked, 5 resources, 130 interrupted.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import tyro

from fieldstone import __version__
from fieldstone.errors import InputError
from fieldstone.field_verbs import Out, Source, mesh, plain_console, render, seconds, splat, train

if TYPE_CHECKING:
    from rich.console import Console

    from fieldstone.run.matching.options import MatchingOptions

GC_THRESHOLD = 100_000
"""New objects between two collections."""

# Heavy imports live in the verbs, so that help and usage errors come at once.


def reconstruct(
    source: Source,
    /,
    out: Out,
    *,
    mapper: Literal["auto", "textbook", "incremental", "global"] = "auto",
    camera_model: str | None = None,
    intrinsics: str | None = None,
    fix_intrinsics: bool = False,
    fix_principal_point: bool = False,
    covariance: bool = False,
    single_camera: bool = False,
    masks: Path | None = None,
    max_image_size: int = 1600,
    threads: int = 0,
    seed: int = 0,
    fresh: bool = False,
) -> int:
    """Camera poses and a point cloud from a folder of photos, or from one with given matches. Run it again to go on
    after a stop.

    Args:
        source: Folder with photos, or in the course format (calibration.txt, matching*.txt and the photos).
        out: Folder for the result: sparse/0 (COLMAP), points.ply, run.json, report.html.
        mapper: auto takes the textbook's stages for given matches, the incremental mapper for photos; global places
            all photos at once, which is faster for large sets.
        camera_model: Model of --intrinsics, such as SIMPLE_RADIAL or OPENCV.
        intrinsics: Its parameters in pixels of the stored photo, as fx,fy,cx,cy.
        fix_intrinsics: They are exact: do not refine them.
        fix_principal_point: Hold the principal point.
        covariance: Also write covariance.safetensors, and the standard deviations of every pose to run.json.
        single_camera: All photos were taken by one camera, whatever their EXIF says.
        masks: Folder with a mask for each photo, named a.jpg.png, a.jpg or a.png for a.jpg. White is kept.
        max_image_size: Longer side of the photos for finding features, in pixels.
        threads: 0 takes all cores. The result is the same for any number.
        seed: Every random number of the run follows from it.
        fresh: Start from nothing, whatever an earlier run has kept in the output folder.
    """
    from fieldstone.mapping.automatic import AutomaticOptions
    from fieldstone.mapping.self_calibration import SelfCalibrationOptions
    from fieldstone.run.reconstruct import ReconstructOptions
    from fieldstone.run.reconstruct import reconstruct as run

    matching = _matching_options(
        camera_model, intrinsics, fix_intrinsics, single_camera, max_image_size, threads or os.cpu_count() or 1
    )
    matching = replace(matching, masks=masks)
    calibration = SelfCalibrationOptions(principal_point=not fix_principal_point)
    incremental = AutomaticOptions(self_calibration=calibration, covariance=covariance)
    options = ReconstructOptions(mapper, matching, incremental=incremental, seed=seed, fresh=fresh)
    console = plain_console()
    with console.status("reading") as status:
        record = run(source, out, options, on_stage=status.update)
    _show_run(console, record, out)
    return 0 if record["summary"]["registered"] >= 2 else 4


def _matching_options(
    camera_model: str | None,
    intrinsics: str | None,
    fix_intrinsics: bool,
    single_camera: bool,
    max_image_size: int,
    threads: int,
) -> MatchingOptions:
    """How photos are matched, and what is known of their cameras."""
    from fieldstone.features.sift import SiftOptions
    from fieldstone.run.matching.options import MatchingOptions

    numbers = None
    if intrinsics is not None:
        try:
            numbers = tuple(float(word) for word in intrinsics.split(","))
        except ValueError:
            message = f"--intrinsics {intrinsics}: give numbers with commas, such as 1400,1400,800,600"
            raise InputError(message) from None
    if fix_intrinsics and numbers is None:
        raise InputError("--fix-intrinsics needs --intrinsics: there is nothing to hold")
    sift = SiftOptions(max_image_size=max_image_size)
    return MatchingOptions(
        sift=sift,
        camera_model=camera_model,
        intrinsics=numbers,
        fix_intrinsics=fix_intrinsics,
        single_camera=single_camera,
        threads=threads,
    )


def demo(*, out: Out = Path("fieldstone-demo"), budget: str = "60s", threads: int = 0, seed: int = 0) -> int:
    """The whole road on photos of a small house that the package makes itself, and what it misses the truth by.

    Args:
        out: Folder for photos, model, field, renders and report.html.
        budget: Time for training the field: 60s, 5m.
        threads: 0 takes all cores. The result of the reconstruction is the same for any number.
        seed: Every random number of the run follows from it.
    """
    from fieldstone.run.demo import run_demo
    from fieldstone.run.matching.options import MatchingOptions
    from fieldstone.run.reconstruct import ReconstructOptions

    console = plain_console()
    options = ReconstructOptions(matching=MatchingOptions(threads=threads or os.cpu_count() or 1), seed=seed)
    with console.status("starting") as status:
        record, metrics = run_demo(
            out,
            options,
            budget_s=seconds(budget),
            on_stage=status.update,
            on_step=lambda p: status.update(f"training: {p.seconds:.0f} s, step {p.step}, PSNR {p.psnr:.2f} dB"),
        )
    _show_run(console, record, out)
    truth = record.get("truth")
    if truth is None:
        return 4
    console.print(
        f"against the truth: rotation off by {truth['rotation_error_mean_deg']:.3f} deg, position by "
        f"{1000 * truth['position_error_mean_m']:.1f} mm on average; held-out views: PSNR {metrics['psnr']:.2f} dB, "
        f"SSIM {metrics['ssim']:.3f}\nopen {out / 'report.html'}",
        markup=False,
    )
    return 0


def report(source: Source, /) -> int:
    """Write report.html of a folder anew, from what lies in it.

    Args:
        source: Folder that reconstruct, train or demo wrote.
    """
    from fieldstone.report.summary import write_report

    path = write_report(source)
    plain_console().print(f"open {path}", markup=False)
    return 0


VERBS = {
    "demo": demo, "reconstruct": reconstruct, "train": train, "render": render, "mesh": mesh, "splat": splat,
    "report": report,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code; a user's mistake ends in one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if list(arguments) == ["--version"]:
        sys.stdout.write(f"fieldstone {__version__}\n")
        return 0
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    try:
        return tyro.extras.subcommand_cli_from_dict(
            VERBS,
            args=list(arguments),
            prog="fieldstone",
            description="Photos in, a scene that you can walk through out.",
        )
    except InputError as error:
        sys.stderr.write(f"fieldstone: {error}\n")
        return 3
    except MemoryError:
        sys.stderr.write("fieldstone: out of memory; use fewer or smaller photos, or close other programs\n")
        return 5
    except OSError as error:
        sys.stderr.write(
            f"fieldstone: {error.filename or 'disk'}: {error.strerror or error}; free space or choose another output\n"
        )
        return 5
    except KeyboardInterrupt:
        sys.stderr.write("fieldstone: interrupted; what was finished is kept\n")
        return 130


def _show_run(console: Console, record: dict[str, Any], out: Path) -> None:
    """The error table, the drops, and one line for every photo that was left out."""
    from rich.table import Table

    table = Table("stage", "photo", *("points", "behind", "mean px", "median px", "RMS px"), box=None)
    for column in table.columns[2:]:
        column.justify = "right"
    for row in record["table"]:
        numbers = (row["mean_px"], row["median_px"], row["rms_px"])
        table.add_row(
            row["stage"], row["photo"], str(row["points"]), str(row["behind"]),
            *("-" if n is None else f"{n:.3f}" for n in numbers),
        )  # fmt: skip
    console.print(table)
    for drop in record["drops"]:
        console.print(f"dropped {drop['observations']:6d}  {drop['stage']}: {drop['reason']}", markup=False)
    for note in record["notes"]:
        console.print(note, markup=False)
    for photo in record["photos"]:
        if not photo["registered"]:
            console.print(f"{photo['name']}: {photo['verdict']}", markup=False, style="yellow")
    summary = record["summary"]
    if summary["mean_px"] is None:
        console.print("no model: no photo could be registered", style="red")
    else:
        console.print(
            f"{summary['registered']} of {summary['photos']} photos, {summary['points']} points, "
            f"{summary['observations']} observations, mean error {summary['mean_px']:.3f} px -> {out}",
            markup=False,
        )


def run() -> NoReturn:
    """The console script: `main`, then out at once.

    Everything is written and no thread is left; taking numba and LLVM apart in order would last another 0.2 s. The
    default threshold of the garbage collector would have it look through all modules again and again while they load.
    """
    gc.set_threshold(GC_THRESHOLD)
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:  # who read the output has seen enough
        code = 0
    logging.shutdown()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    run()
