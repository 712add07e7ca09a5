"""Photos to poses, ours against pycolmap and openmvg-rs, interleaved on one folder: time, coverage and accuracy.

    python -m benchmarks.sfm [FOLDER ...] [--known-intrinsics] [--runs 3] [--threads 2] [--size 1600] [--out ROWS.json]

Every run is a process of its own, so that memory and time are its own; kernels are compiled before the first.
Errors are against the folder's ground truth after a Sim3 fit, where it has one.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.data import DATA, present
from benchmarks.ground_truth import read_ground_truth
from benchmarks.rows import QUALITY, TIMES, Better, Row, add_out_option, write_rows
from fieldstone.evaluate.reconstruction_metrics import area_under_curve, pairwise_pose_errors_deg
from fieldstone.io.models.colmap import read_colmap
from fieldstone.scene.alignment import align
from fieldstone.scene.reconstruction import Reconstruction

THRESHOLDS_DEG = (0.5, 1.0, 3.0, 5.0, 10.0)
DEFAULT_NAMES = ("strecha_fountain_p11", "strecha_entry_p10")
PEERS = ("fieldstone", "incremental", "global", "openmvg")
"""The second and third are pycolmap's mappers."""


@dataclass(frozen=True)
class Setting:
    """What both sides are given."""

    photos: Path
    size: int
    threads: int
    seed: int
    intrinsics: str | None
    """PINHOLE parameters "fx,fy,cx,cy" of the stored photos, or None for photos alone."""


def main() -> None:
    """Run the comparison and print one table per folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_NAMES])
    parser.add_argument("--known-intrinsics", action="store_true", help="give both sides the true calibration")
    parser.add_argument("--runs", type=int, default=3, help="seeds 0 to RUNS - 1")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--size", type=int, default=1600)
    parser.add_argument("--only", choices=PEERS, action="append", help="leave the others out")
    add_out_option(parser, "sfm")
    arguments = parser.parse_args()
    kept: list[Row] = []
    for folder in present(arguments.folders):
        truth = read_ground_truth(folder)
        photos = folder / "images" if (folder / "images").is_dir() else folder
        intrinsics = None
        if arguments.known_intrinsics:
            if truth is None:
                parser.error(f"{folder} has no ground truth to take intrinsics from")
            camera = truth.cameras[0]
            intrinsics = ",".join(repr(float(x)) for x in (*camera.focal, *camera.principal_point))
        rows = []
        for seed in range(arguments.runs):
            setting = Setting(photos, arguments.size, arguments.threads, seed, intrinsics)
            rows += [measure(peer, setting, truth) for peer in arguments.only or PEERS[:3]]
        show(folder.name, rows)
        kept += rows_of(folder.name + ("/known intrinsics" if arguments.known_intrinsics else ""), rows)
    write_rows(kept, arguments.out)


def measure(peer: str, setting: Setting, truth: Reconstruction | None) -> dict[str, Any]:
    """One run of one side in a process of its own."""
    out = Path(tempfile.mkdtemp(prefix=f"bench-{peer}-"))
    environment = {**os.environ, "OMP_NUM_THREADS": str(setting.threads)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package has its bytecode
    given = json.dumps({**vars(setting), "photos": str(setting.photos)})
    if peer == "fieldstone":
        command = [
            sys.executable, "-m", "fieldstone.cli", "reconstruct", str(setting.photos), "-o", str(out),
            "--seed", str(setting.seed), "--threads", str(setting.threads), "--max-image-size", str(setting.size),
        ]  # fmt: skip
        if setting.intrinsics:
            command += ["--intrinsics", setting.intrinsics, "--fix-intrinsics"]
    elif peer == "openmvg":
        command = [sys.executable, "-m", "benchmarks.openmvg_runner", given, str(out)]
    else:
        command = [sys.executable, "-m", "benchmarks.pycolmap_runner", peer, given, str(out)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    row: dict[str, Any] = {
        "peer": peer,
        "seed": setting.seed,
        "wall_s": wall,
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "exit": done.returncode,
    }
    model_folder = out / "sparse" / "0"
    if model_folder.is_dir():
        row |= describe(read_colmap(model_folder), truth)
    stages = out / "run.json"
    if stages.is_file():
        row["stages"] = json.loads(stages.read_text())["seconds"]
        if peer == "openmvg":  # without reading and reducing the photos
            row["wall_s"] = row["stages"]["everything"]
    if done.returncode not in (0, 4):
        row["error"] = done.stderr.strip()[-300:]
    shutil.rmtree(out)
    return row


def describe(model: Reconstruction, truth: Reconstruction | None) -> dict[str, Any]:
    """Coverage and accuracy of one model."""
    row: dict[str, Any] = {
        "registered": len(model.registered()),
        "points": len(model.points),
        "track": len(model.observations) / max(len(model.points), 1),
        "error_px": float(np.nanmean(model.reprojection_errors())),
    }
    if truth is not None and len(model.registered()) > 2:
        row["position"] = float(align(model, truth).position_error.mean())
        row["auc"] = area_under_curve(pairwise_pose_errors_deg(model, truth), THRESHOLDS_DEG)
    return row


def rows_of(name: str, rows: list[dict[str, Any]]) -> list[Row]:
    """Medians over the seeds, against the incremental mapper of pycolmap where it ran."""
    wanted: list[tuple[str, str, Better]] = [
        ("wall_s", "s", "lower"),
        ("cpu_s", "s", "lower"),
        ("registered", "photos", "higher"),
        ("points", "points", "higher"),
        ("error_px", "px", "lower"),
        ("position", "scene units", "lower"),
    ]
    found = []
    for key, unit, better in wanted:
        of = {peer: [row[key] for row in rows if row["peer"] == peer and key in row] for peer in PEERS}
        if not of["fieldstone"]:
            continue
        other = float(np.median(of["incremental"])) if of["incremental"] else None
        peer = None if other is None else "pycolmap incremental"
        tolerance = TIMES if unit == "s" else QUALITY
        found.append(Row(f"sfm/{name}/{key}", float(np.median(of["fieldstone"])), unit, better, tolerance, peer, other))
    return found


def show(name: str, rows: list[dict[str, Any]]) -> None:
    """Print the rows of one folder and the ratio of the median times."""
    out = sys.stdout.write
    out(f"\n{name}\n")
    for row in rows:
        auc = " ".join(f"{a:5.1f}" for a in row.get("auc", []))
        out(
            f"  {row['peer']:12s} seed {row['seed']}  wall {row['wall_s']:7.2f} s  cpu {row['cpu_s']:7.2f} s  "
            f"photos {row.get('registered', 0):3d}  points {row.get('points', 0):6d}  "
            f"track {row.get('track', 0):4.2f}  "
            f"{row.get('error_px', float('nan')):5.3f} px  position {row.get('position', float('nan')) * 1e3:8.2f}e-3  "
            f"AUC@{'/'.join(f'{t:g}' for t in THRESHOLDS_DEG)} {auc}\n"
        )
        if "stages" in row:
            out(f"      {', '.join(f'{k} {v:.2f}' for k, v in row['stages'].items())}\n")
        if "error" in row:
            out(f"      {row['error']}\n")
    medians = {
        peer: np.median([r["wall_s"] for r in rows if r["peer"] == peer])
        for peer in PEERS
        if any(r["peer"] == peer for r in rows)
    }
    for peer in PEERS[1:]:
        if "fieldstone" in medians and peer in medians:
            out(f"  wall, fieldstone / {peer}: {medians['fieldstone'] / medians[peer]:.3f}\n")


if __name__ == "__main__":
    main()
