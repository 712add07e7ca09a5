"""How fast fields are shown and learned: frames per second by size, and seconds until a training PSNR by field.

    python -m benchmarks.field_speed SCENE OUT [--sizes 100,200,400,800] [--threads 2] [--out ROWS.json]
    python -m benchmarks.field_speed SCENE OUT --networks 120 [--target-db 25]

SCENE is any source of `fieldstone train`, OUT a folder that it trained a fast field in (with `curve.json`). Frames are
those of the training photos; CPU seconds are of all threads together, and on a busy machine the better measure: a
frame takes at least their share of each thread. With --networks, the small network of the course and the original NeRF
are trained for so many seconds each: a time until the target that they do not reach is more than that. PSNR is that of
the last 20 batches of training rays, for the fast field only those that meet the object, which are the harder ones.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, add_out_option, write_rows
from fieldstone.field.base.budget import Budget
from fieldstone.field.base.training import PRESETS, train
from fieldstone.rendering.views import progressive_views, render_view
from fieldstone.run.field import open_field
from fieldstone.run.field_input import read_ray_dataset
from fieldstone.run.network_training import open_training
from fieldstone.run.surface import some_views

FRAMES = 12
BATCHES = 20


def main() -> None:
    """Frames per second, then, if asked for, the networks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("trained", type=Path, metavar="OUT")
    parser.add_argument("--sizes", default="100,200,400,800")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--networks", type=float, default=0.0)
    parser.add_argument("--target-db", type=float, default=25.0)
    add_out_option(parser, "field_speed")
    arguments = parser.parse_args()
    rows: list[Row] = []
    for size in map(int, arguments.sizes.split(",")):
        wall, cpu, first = frame_seconds(arguments.trained, size, arguments.threads)
        rows += [
            Row(f"field_speed/{size} px/frame wall", 1e3 * wall, "ms", "lower"),
            Row(f"field_speed/{size} px/frame cpu", 1e3 * cpu, "ms", "lower"),
            Row(f"field_speed/{size} px/first shown", 1e3 * first, "ms", "lower"),
        ]
        show(
            f"{size:5d} px: {1 / wall:6.1f} frames/s ({1e3 * cpu:6.1f} ms of CPU a frame), "
            f"something to see after {1e3 * first:.1f} ms"
        )
    write_rows(rows, arguments.out)
    if arguments.networks <= 0:
        return
    curve = open_field(arguments.trained).curve
    report("fast", [p.seconds for p in curve], [p.psnr for p in curve], arguments.target_db)
    for name in ("tiny", "nerf"):
        seconds, psnr = network_curve(arguments.scene, name, arguments.networks, arguments.threads)
        report(name, seconds, psnr, arguments.target_db)


def frame_seconds(out: Path, size: int, threads: int) -> tuple[float, float, float]:
    """Wall and CPU seconds of a frame of a trained fast field, and until something is seen of it; kernels compiled."""
    field = open_field(out)
    views = some_views(field.photos, FRAMES, size)
    with field.renderer(threads=threads) as render:
        render_view(render, *views[0])
        began, began_cpu = time.perf_counter(), time.process_time()
        for camera, pose in views:
            render_view(render, camera, pose)
        wall, cpu = time.perf_counter() - began, time.process_time() - began_cpu
        began = time.perf_counter()
        for camera, pose in views:
            next(progressive_views(render, camera, pose))
        first = time.perf_counter() - began
    return wall / len(views), cpu / len(views), first / len(views)


def network_curve(scene: Path, name: str, budget_s: float, threads: int) -> tuple[list[float], list[float]]:
    """Seconds and training PSNR of every step of a classical network."""
    options = PRESETS[name]
    dataset = read_ray_dataset(scene, None, options.image_size_px)
    with open_training(options, dataset.frame, dataset, seed=0, device="cpu", threads=threads) as training:
        _, curve = train(training, training.start(), budget=Budget.start(budget_s))
    return [p.seconds for p in curve], [p.psnr for p in curve]


def report(name: str, seconds: Sequence[float], psnr: Sequence[float], target: float) -> None:
    """When the mean of the last batches reached the target, and what it came to."""
    mean = (
        np.convolve(psnr, np.full(BATCHES, 1 / BATCHES), "valid") if len(psnr) >= BATCHES else np.array([np.mean(psnr)])
    )
    reached = np.flatnonzero(mean >= target)
    when = f"{target:g} dB after {seconds[reached[0] + len(psnr) - len(mean)]:.1f} s" if len(reached) else "not reached"
    show(f"{name:5s}: {when}; best {mean.max():.2f} dB in {seconds[-1]:.0f} s, {len(psnr)} steps")


def show(line: str) -> None:
    """One line of the result."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
