"""The grid field: quality against seconds, and nanoseconds of every kernel of a training step.

    python -m benchmarks.field [SCENE] [--budgets 10,60] [--no-alpha] [--threads 2] [--folder FOLDER] [--out ROWS.json]

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

from benchmarks.data import DATA, present
from benchmarks.rows import QUALITY, Row, add_out_option, write_rows
from fieldstone.field.grid.composite_numba import composite_backward
from fieldstone.field.grid.decoder import HIDDEN
from fieldstone.field.grid.decoder_numba import decode_backward, decode_directions, decode_numba
from fieldstone.field.grid.exposure import gains_of
from fieldstone.field.grid.field import FOREVER
from fieldstone.field.grid.interpolation_numba import add_gradient, step_by_sample, step_touched
from fieldstone.field.grid.march_numba import march_rays
from fieldstone.field.grid.step_numba import draw_rays
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.field.grid_training.state import GridState
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.run.field import open_field
from fieldstone.run.field_input import read_ray_dataset
from fieldstone.run.grid_planning import MAX_SIZE_PX
from fieldstone.run.options import TrainOptions
from fieldstone.run.train import train

REPEATS = 30


def main() -> None:
    """Train for each budget, then time the kernels on the last field."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?", default=DATA / "lego_100")
    parser.add_argument("--budgets", default="10,60")
    parser.add_argument("--no-alpha", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where the fields are left")
    add_out_option(parser, "field")
    arguments = parser.parse_args()
    if not present([arguments.scene]):
        return
    rows: list[Row] = []
    folder = arguments.folder or Path(tempfile.mkdtemp())
    out = folder
    for budget in map(float, arguments.budgets.split(",")):
        out = folder / f"{budget:g}s"
        cpu = time.process_time()
        options = TrainOptions(budget_s=budget, threads=arguments.threads, alpha=not arguments.no_alpha)
        field = train(arguments.scene, options, keep_in=out)
        metrics, plan = field.metrics, field.plan
        assert metrics is not None
        assert plan is not None
        show(
            f"{budget:6g} s: PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.3f}, {metrics.seconds:.1f} s, "
            f"{metrics.steps} steps, finest {plan.schedule.finest}, CPU {time.process_time() - cpu:.0f} s with "
            "compiling and rendering"
        )
        name = f"field/{arguments.scene.name}{'/no alpha' if arguments.no_alpha else ''}/{budget:g} s"
        rows += [
            Row(f"{name}/psnr", metrics.psnr, "dB", "higher", QUALITY),
            Row(f"{name}/ssim", metrics.ssim, "1", "higher", QUALITY),
            Row(f"{name}/steps", metrics.steps, "steps", "higher"),
        ]
    kernels = profile(arguments.scene, out, use_alpha=not arguments.no_alpha)
    rows += [Row(f"field/kernels/{kernel}", ns, "ns", "lower") for kernel, ns in kernels]
    write_rows(rows, arguments.out)


def profile(scene: Path, out: Path, *, use_alpha: bool) -> list[tuple[str, float]]:
    """Nanoseconds of each kernel per sample that weighs, on the field of a run."""
    trained = open_field(out)
    plan = trained.plan
    assert plan is not None
    dataset = read_ray_dataset(scene, None, MAX_SIZE_PX)
    with ThreadPoolExecutor(1) as executor:
        training = prepare_grid_training(
            dataset.train,
            dataset.frame,
            plan,
            seed=0,
            executor=executor,
            use_alpha=use_alpha,
            points_in_world=dataset.points_in_world,
            seen=dataset.seen,
            bounded=dataset.bounded,
        )
        rows, about = kernel_times(training, training.from_tensors(trained.state))
    show(about)
    for name, nanoseconds in rows:
        show(f"  {name:28s} {nanoseconds:7.1f} ns")
    show(f"  {'all':28s} {sum(ns for _, ns in rows):7.1f} ns")
    return rows


def kernel_times(training: GridTraining, state: GridState) -> tuple[list[tuple[str, float]], str]:
    """Nanoseconds per weighing sample of each kernel, and what was measured."""
    buffers, field, plan = state.buffers, state.field, state.plan
    chunk, width, used = buffers.chunks[0], field.width, 4 * field.layout.num_levels
    rays, samples, work = chunk.rays, chunk.samples, chunk.work
    count, levels = int(state.chunk_rays[0]), field.layout.num_levels
    background = training.frame.background.astype(np.float32)
    transposed = np.ascontiguousarray(field.decoder.feature_weights.reshape(-1, HIDDEN).T).reshape(-1)
    gains = gains_of(state.exposure)
    rates, decay_factors, mean_square = np.zeros(8, np.float32), np.ones(8, np.float32), state.mean_square
    terms = plan.losses.terms(1.0, alpha_known=True)
    tiny, decay = np.float32(1e-8), np.float32(plan.rates.mean_square_decay)

    def draw() -> None:
        draw_rays(training.rays, training.space, gains, state.cursor, count, 0, background, rays, 0)

    def march() -> tuple[int, int, int]:
        return march_rays(
            buffers.grid,
            buffers.box,
            buffers.march,
            rays.origins,
            rays.directions,
            rays.jitter,
            FOREVER,
            count,
            width,
            samples,
            rays.first,
            rays.end_transmittance,
        )

    draw()
    num_rays, n, evaluations = march()
    counts = np.array([n], dtype=np.int64)

    def decode() -> None:
        decode_directions(field.decoder, rays.views, num_rays, work.per_ray)
        decode_numba(field.decoder, n, samples.features, width, used, samples.ray, work.per_ray, work.hidden, work.rgb)

    def composite() -> None:
        composite_backward(samples, rays, work, num_rays, terms, np.float32(1e-2))

    def back() -> None:
        decode_backward(
            field.decoder,
            transposed,
            n,
            num_rays,
            samples.features,
            width,
            used,
            samples.ray,
            rays.views,
            work.hidden,
            work.d_color,
            work.d_log_density,
            work.d_per_ray,
            chunk.gradient,
        )

    def scatter(level: int) -> None:
        for half in (0, 1):
            arguments = (
                buffers.grid,
                level,
                half,
                counts,
                plan.sampling.samples_per_chunk,
                samples.position,
                samples.features,
                width,
            )
            if level < levels - plan.rates.immediate_levels:
                add_gradient(*arguments, buffers.gradient, buffers.touched)
            else:
                step_by_sample(*arguments, mean_square, rates, decay_factors, decay, tiny)

    def step() -> None:
        touched = len(buffers.touched)
        step_touched(
            field.table, mean_square, buffers.gradient, buffers.touched, 0, touched, rates, decay_factors, decay, tiny
        )

    rows = [("draw rays", best(draw)), ("march and interpolate", best(march)), ("decode", best(decode))]
    rows += [("composite, loss", best(composite)), ("decode backward", best(back))]
    for level, resolution in enumerate(field.layout.resolutions):
        rows.append((f"scatter level {resolution}", best(lambda level=level: scatter(level))))
    for level in range(levels - plan.rates.immediate_levels):
        scatter(level)
    rows.append(
        (
            "step touched blocks",
            best(step, before=lambda: [scatter(k) for k in range(levels - plan.rates.immediate_levels)]),
        )
    )
    per_ray = f"{evaluations / num_rays:.1f} density evaluations and {n / num_rays:.1f} samples that weigh per ray"
    return [(name, seconds / n * 1e9) for name, seconds in rows], f"{num_rays} rays, {per_ray}"


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
