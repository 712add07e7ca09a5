"""Bundle adjustment, ours against Ceres (through pycolmap) and scipy, interleaved: seconds and final costs.

    python -m benchmarks.bundle [NAME or FILE.txt ...] [--threads 1] [--runs 3] [--scipy] [--out ROWS.json]

Names: ring50, ring200, short200 (the first two cameras almost in one place), ring1000 (1 M observations), crowd1000
(any view may see any point), own200 (every view its own camera); files are BAL problems. Ceres is run with its gauge
free and with two cameras held; its seconds are those of the solver alone, ours are the whole call. CPU seconds are
the comparison on a machine with other work. All stop when a step lowers the cost by less than 1e-6 of it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.bundle_problems import RingOptions, ring_problem
from benchmarks.rows import QUALITY, TIMES, Row, add_out_option, write_rows
from fieldstone.io.models.bal import read_bal
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.scipy_reference import bundle_adjust_scipy

GENERATED = {
    "ring50": RingOptions(50, 10_000, reach=25),
    "ring200": RingOptions(200, 60_000, reach=8),
    "short200": RingOptions(200, 60_000, reach=8, short_baseline=True),
    "own200": RingOptions(200, 60_000, reach=8, per_view_cameras=True),
    "ring1000": RingOptions(1000, 210_000, reach=12),
    "crowd1000": RingOptions(1000, 200_000, reach=499),
}
DEFAULT_NAMES = ("ring50", "ring200", "short200", "ring1000")
RELATIVE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Run:
    """One adjustment."""

    wall_s: float
    cpu_s: float
    cost: float
    steps: int


def main() -> None:
    """Run every solver on every problem and print a table for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=DEFAULT_NAMES)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--scipy", action="store_true", help="scipy as well: minutes on the larger problems")
    parser.add_argument("--no-ceres", action="store_true")
    add_out_option(parser, "bundle")
    arguments = parser.parse_args()
    rows: list[Row] = []
    bundle_adjust(ring_problem(RingOptions(4, 50, reach=2), np.random.default_rng(0)))  # compile first
    for name in arguments.problems:
        problem = load(name)
        solvers: dict[str, Callable[[BundleProblem], Run]] = {"fieldstone": lambda p: run_ours(p, arguments.threads)}
        if not arguments.no_ceres:
            solvers["ceres, gauge free"] = lambda p: run_ceres(p, arguments.threads, hold_two_cameras=False)
            solvers["ceres, two cameras held"] = lambda p: run_ceres(p, arguments.threads, hold_two_cameras=True)
        if arguments.scipy:
            solvers["scipy"] = run_scipy
        runs: dict[str, list[Run]] = {solver: [] for solver in solvers}
        for _ in range(arguments.runs):
            for solver, run in solvers.items():
                runs[solver].append(run(problem))
        report(name, problem, runs)
        rows += rows_of(Path(name).stem, runs)
    write_rows(rows, arguments.out)


def load(name: str) -> BundleProblem:
    """A generated problem by name, or a BAL file."""
    return ring_problem(GENERATED[name], np.random.default_rng(0)) if name in GENERATED else read_bal(Path(name))


def run_ours(problem: BundleProblem, threads: int) -> Run:
    """The compiled solver, from the problem to the adjusted problem."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = bundle_adjust(problem, BundleOptions(relative_tolerance=RELATIVE_TOLERANCE, threads=threads))
    return Run(time.perf_counter() - wall, time.process_time() - cpu, result.final_cost, result.iterations)


def run_scipy(problem: BundleProblem) -> Run:
    """The textbook solver."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = bundle_adjust_scipy(problem, relative_tolerance=RELATIVE_TOLERANCE)
    return Run(time.perf_counter() - wall, time.process_time() - cpu, result.final_cost, result.num_evaluations)


def run_ceres(problem: BundleProblem, threads: int, *, hold_two_cameras: bool) -> Run:
    """Ceres as pycolmap sets it up, solver time only."""
    import pycolmap

    model = colmap_reconstruction(problem)
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(problem.num_views):
        config.add_image(i + 1)
    if hold_two_cameras:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    solver = options.ceres.solver_options
    solver.num_threads = threads
    solver.function_tolerance = RELATIVE_TOLERANCE
    solver.gradient_tolerance = 1e-10
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    wall, cpu = time.perf_counter(), time.process_time()
    summary: Any = adjuster.solve()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    result = summary.ceres_summary
    return Run(wall, cpu, result.final_cost, result.num_successful_steps + result.num_unsuccessful_steps)


def colmap_reconstruction(problem: BundleProblem):
    """The problem as pycolmap's objects; ids are indices plus one."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for c, camera in enumerate(problem.cameras):
        size = {"width": camera.width, "height": camera.height}
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=c + 1, model=camera.model, params=camera.params, **size)
        )
    by_view = np.argsort(problem.view, kind="stable")
    starts = np.searchsorted(problem.view[by_view], np.arange(problem.num_views + 1))
    keypoint = np.empty(len(by_view), dtype=np.int64)
    keypoint[by_view] = np.arange(len(by_view)) - np.repeat(starts[:-1], np.diff(starts))
    for i, c in enumerate(problem.camera_of_view):
        pixels = problem.pixels[by_view[starts[i] : starts[i + 1]]]
        image = pycolmap.Image(name=str(i), keypoints=pixels, camera_id=int(c) + 1, image_id=i + 1)
        pose = problem.cam_from_world[i].matrix()[:3]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    by_point = np.argsort(problem.point, kind="stable")
    starts = np.searchsorted(problem.point[by_point], np.arange(len(problem.points) + 1))
    black = np.zeros(3, dtype=np.uint8)
    for j, xyz in enumerate(problem.points):
        rows = by_point[starts[j] : starts[j + 1]]
        elements = [pycolmap.TrackElement(int(problem.view[k]) + 1, int(keypoint[k])) for k in rows]
        model.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=xyz, track=pycolmap.Track(elements), color=black))
    return model


def report(name: str, problem: BundleProblem, runs: dict[str, list[Run]]) -> None:
    """Medians per solver, and ours as a share of the faster Ceres and of scipy."""
    out = sys.stdout.write
    out(f"\n{name}: {problem.num_views} views, {len(problem.points)} points, {len(problem.view)} observations\n")
    out(f"{'':24s} {'wall s':>8s} {'CPU s':>8s} {'steps':>6s} {'cost':>16s}\n")
    wall = {solver: median(run.wall_s for run in of) for solver, of in runs.items()}
    cpu = {solver: median(run.cpu_s for run in of) for solver, of in runs.items()}
    for solver, of in runs.items():
        out(f"{solver:24s} {wall[solver]:8.3f} {cpu[solver]:8.3f} {of[0].steps:6d} {of[0].cost:16.6f}\n")
    ours = runs["fieldstone"][0].cost
    for peer in ("ceres", "scipy"):
        peers = [solver for solver in runs if solver.startswith(peer)]
        if peers:
            best = min(runs[solver][0].cost for solver in peers)
            out(
                f"ours / fastest {peer}: wall {wall['fieldstone'] / min(wall[s] for s in peers):.3f}, "
                f"CPU {cpu['fieldstone'] / min(cpu[s] for s in peers):.3f}, cost {100 * (ours / best - 1):+.5f} %\n"
            )
    sys.stdout.flush()


def rows_of(name: str, runs: dict[str, list[Run]]) -> list[Row]:
    """Median seconds and final cost, against the Ceres that is best at each, and the scipy where there is no Ceres."""
    peers = [s for s in runs if s.startswith("ceres")] or [s for s in runs if s == "scipy"]
    peer = peers[0].partition(",")[0] if peers else None

    def row(metric: str, unit: str, number: Callable[[Run], float], tolerance: float = TIMES) -> Row:
        ours, *others = (median(map(number, runs[solver])) for solver in ["fieldstone", *peers])
        return Row(f"bundle/{name}/{metric}", ours, unit, "lower", tolerance, peer, min(others, default=None))

    return [
        row("wall", "s", lambda run: run.wall_s),
        row("cpu", "s", lambda run: run.cpu_s),
        row("cost", "px^2", lambda run: run.cost, QUALITY),
    ]


if __name__ == "__main__":
    main()
