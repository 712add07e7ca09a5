"""The whole road on photos that the package makes itself, and what it misses the truth by."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fieldstone.field.base.training import OnStep
from fieldstone.io.files.atomic import write_json
from fieldstone.io.models.colmap import find_colmap_model, read_colmap
from fieldstone.run.fast_fields import train_fast_run
from fieldstone.run.matching.photos_to_graph import OnStage
from fieldstone.run.reconstruct import ReconstructOptions, reconstruct
from fieldstone.scene.alignment import align
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.synthetic.photos import PhotoOptions, make_photos, write_photos


def run_demo(
    out: Path,
    options: ReconstructOptions,
    *,
    budget_s: float,
    photo_options: PhotoOptions | None = None,
    on_stage: OnStage = lambda stage: None,
    on_step: OnStep = lambda point: None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Photograph a synthetic house, reconstruct it, train a field on it, and compare with the truth.

    Everything goes to `out`: `photos/`, what `reconstruct` writes, what `train` writes, one report.

    Returns:
        What `run.json` (with a key `truth`) and `metrics.json` hold.
    """
    photo_options = photo_options or PhotoOptions()
    threads = options.matching.threads
    on_stage("photographing a house")
    photos = make_photos(photo_options, np.random.default_rng(options.seed), threads=threads)
    write_photos(photos, out / "photos", photo_options)
    record = reconstruct(out / "photos", out, options, on_stage=on_stage)
    if find_colmap_model(out) is not None:
        record["truth"] = errors_against_truth(read_colmap(out), photos.truth)
        write_json(out / "run.json", record)
    metrics = train_fast_run(
        out,
        out,
        budget_s=budget_s,
        seed=options.seed,
        threads=threads,
        on_step=on_step,
        on_stage=on_stage,
    )
    return record, metrics


def errors_against_truth(model: Reconstruction, truth: Reconstruction) -> dict[str, Any]:
    """Pose errors after the similarity that brings the model into the frame of the truth (metres)."""
    comparison = align(model, truth)
    rotation_deg = np.rad2deg(comparison.rotation_error)
    focal = float(model.cameras[0].focal.mean() / truth.cameras[0].focal.mean() - 1.0)
    return {
        "photos": len(comparison.names),
        "rotation_error_mean_deg": float(rotation_deg.mean()),
        "rotation_error_max_deg": float(rotation_deg.max()),
        "position_error_mean_m": float(comparison.position_error.mean()),
        "position_error_max_m": float(comparison.position_error.max()),
        "focal_error_percent": 100.0 * focal,
    }
