"""The fast field: quality against seconds, and nanoseconds of every kernel of a training step.

    python -m benchmarks.field SCENE --budgets 10,60 [--no-alpha] [--threads 2] [--out FOLDER]

SCENE is any source of `fieldstone train`. Quality is PSNR on the held-out views, by the protocol in metrics.json; on a
busy machine compare CPU seconds and steps rather than seconds. Kernels are timed on one thread, on the rays that the
trained field would draw next, best of several runs; numbers are per sample that weighs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from fieldstone.field.grid.decoder import HIDDEN
from fieldstone.field.grid.decoder_numba import decode_backward, decode_directions, decode_numba
from fieldstone.field.grid.exposure import gains_of
from fieldstone.field.grid.field import FOREVER
from fieldstone.field.grid.interpolation_numba import add_gradient, step_by_sample, step_touched
from fieldstone.field.grid.march_numba import composite_backward, march_rays
from fieldstone.field.grid.step_numba import draw_rays
from fieldstone.field.grid_training.plan import plan_from_json
from fieldstone.field.grid_training.training import FastState, FastTraining, fast_training
from fieldstone.io.files.checkpoint import read_checkpoint
from fieldstone.run.fast_fields import MAX_SIZE_PX, train_fast_run
from fieldstone.run.field_input import read_ray_dataset
from fieldstone.run.fields import split_tensors

REPEATS = 30


def main() -> None:
    """Train for each budget, then time the kernels on the last field."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--budgets", default="10,60")
    parser.add_argument("--no-alpha", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    folder = arguments.out or Path(tempfile.mkdtemp())
    out = folder
    for budget in map(float, arguments.budgets.split(",")):
        out = folder / f"{budget:g}s"
        cpu = time.process_time()
        metrics = train_fast_run(
            arguments.scene, out, budget_s=budget, threads=arguments.threads, use_alpha=not arguments.no_alpha
        )
        show(
            f"{budget:6g} s: PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.3f}, {metrics['seconds']:.1f} s, "
            f"{metrics['steps']} steps, finest {metrics['plan']['finest']}, CPU {time.process_time() - cpu:.0f} s with "
            "compiling and rendering"
        )
    profile(arguments.scene, out, use_alpha=not arguments.no_alpha)


def profile(scene: Path, out: Path, *, use_alpha: bool) -> None:
    """Time the kernels on the field of a run."""
    tensors, _ = read_checkpoint(out / "checkpoint.safetensors")
    _, state_tensors = split_tensors(tensors)
    plan = plan_from_json(state_tensors["plan"].tobytes().decode())
    dataset = read_ray_dataset(scene, None, MAX_SIZE_PX)
    with ThreadPoolExecutor(1) as executor:
        training = fast_training(
            dataset.train, dataset.frame, plan, seed=0, executor=executor, use_alpha=use_alpha,
            points_in_world=dataset.points_in_world, seen=dataset.seen, bounded=dataset.bounded,
        )  # fmt: skip
        rows, about = kernel_times(training, training.from_tensors(state_tensors))
    show(about)
    for name, nanoseconds in rows:
        show(f"  {name:28s} {nanoseconds:7.1f} ns")
    show(f"  {'all':28s} {sum(ns for _, ns in rows):7.1f} ns")


def kernel_times(training: FastTraining, state: FastState) -> tuple[list[tuple[str, float]], str]:
    """Nanoseconds per weighing sample of each kernel, and what was measured."""
    room, field, plan = state.workspace, state.field, state.plan
    chunk, width, used = room.chunks[0], field.width, 4 * field.layout.num_levels
    rays, samples, work = chunk.rays, chunk.samples, chunk.work
    count, levels = int(state.chunk_rays[0]), field.layout.num_levels
    background = training.frame.background.astype(np.float32)
    transposed = np.ascontiguousarray(field.decoder.feature_weights.reshape(-1, HIDDEN).T).reshape(-1)
    gains = gains_of(state.exposure)
    rates, kept, velocity = np.zeros(8, np.float32), np.ones(8, np.float32), state.velocity
    tiny, decay = np.float32(1e-8), np.float32(plan.decay)

    def draw() -> None:
        draw_rays(training.rays, training.space, gains, state.cursor, count, 0, background, rays, 0)

    def march() -> tuple[int, int, int]:
        return march_rays(
            room.grid, room.box, room.march, rays.origins, rays.directions, rays.jitter, FOREVER, count, width, samples,
            rays.first, rays.passed,
        )  # fmt: skip

    draw()
    num_rays, n, asked = march()
    counts = np.array([n], dtype=np.int64)

    def decode() -> None:
        decode_directions(field.decoder, rays.views, num_rays, work.per_ray)
        decode_numba(field.decoder, n, samples.features, width, used, samples.ray, work.per_ray, work.hidden, work.rgb)

    def composite() -> None:
        composite_backward(
            samples, num_rays, rays.first, rays.passed, rays.target, rays.background, rays.gain, work.rgb,
            work.d_weight, np.float32(1e-2), np.float32(plan.sparsity), np.float32(0), work.d_color, work.d_raw,
            work.d_gain,
        )  # fmt: skip

    def back() -> None:
        decode_backward(
            field.decoder, transposed, n, num_rays, samples.features, width, used, samples.ray, rays.views, work.hidden,
            work.d_color, work.d_raw, work.d_per_ray, chunk.gradient,
        )  # fmt: skip

    def scatter(level: int) -> None:
        for half in (0, 1):
            arguments = (
                room.grid,
                level,
                half,
                counts,
                plan.samples_per_chunk,
                samples.position,
                samples.features,
                width,
            )
            if level < levels - plan.immediate_levels:
                add_gradient(*arguments, room.gradient, room.touched)
            else:
                step_by_sample(*arguments, velocity, rates, kept, decay, tiny)

    def step() -> None:
        touched = len(room.touched)
        step_touched(field.table, velocity, room.gradient, room.touched, 0, touched, rates, kept, decay, tiny)

    rows = [("draw rays", best(draw)), ("march and interpolate", best(march)), ("decode", best(decode))]
    rows += [("composite, loss", best(composite)), ("decode backward", best(back))]
    for level, resolution in enumerate(field.layout.resolutions):
        rows.append((f"scatter level {resolution}", best(lambda level=level: scatter(level))))
    for level in range(levels - plan.immediate_levels):
        scatter(level)
    rows.append(
        ("step touched blocks", best(step, before=lambda: [scatter(k) for k in range(levels - plan.immediate_levels)]))
    )
    about = f"{num_rays} rays, {asked / num_rays:.1f} steps asked and {n / num_rays:.1f} samples that weigh per ray"
    return [(name, seconds / n * 1e9) for name, seconds in rows], about


def best(work: Callable[[], object], before: Callable[[], object] = lambda: None) -> float:
    """Shortest of several runs, in seconds."""
    times = []
    for _ in range(REPEATS):
        before()
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def show(line: str) -> None:
    """One line of the result."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
