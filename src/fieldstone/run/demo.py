"""The whole road on photos that the package makes itself, and what it misses the truth by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldstone.progress import OnProgress, Progress, silent
from fieldstone.records.field import FieldMetrics
from fieldstone.records.files import from_json
from fieldstone.records.mapping import RunRecord, TruthErrors
from fieldstone.run.fast_fields import train_fast_run
from fieldstone.run.folder import RunFolder
from fieldstone.run.options import DemoOptions, workers
from fieldstone.run.reconstruct import reconstruct
from fieldstone.run.reconstruct_options import ReconstructOptions
from fieldstone.scene.alignment import align
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.synthetic.photos import PhotoOptions, make_photos, write_photos


def run_demo(
    out: Path,
    options: DemoOptions,
    *,
    photo_options: PhotoOptions | None = None,
    on_progress: OnProgress = silent,
) -> tuple[RunRecord, FieldMetrics | None]:
    """Photograph a synthetic house, reconstruct it, train a field on it, and compare with the truth.

    Everything goes to `out`: `photos/`, what `reconstruct` writes, what `train` writes, one report.

    Returns:
        What `run.json` and `metrics.json` hold; no metrics without a model.
    """
    photo_options = photo_options or PhotoOptions()
    threads = workers(options.threads)
    on_progress(Progress("photographing a house"))
    photos = make_photos(photo_options, np.random.default_rng(options.seed), threads=threads)
    write_photos(photos, out / "photos", photo_options)
    settings = ReconstructOptions(threads=options.threads, seed=options.seed)
    scene = reconstruct(out / "photos", settings, keep_in=out, on_progress=on_progress)
    record = scene.record
    if not scene.summary.registered:
        return record, None
    record = replace(record, truth=errors_against_truth(scene.model, photos.truth))
    RunFolder(out).write_run(record)
    metrics = train_fast_run(
        out,
        out,
        budget_s=options.budget_s or 60.0,
        seed=options.seed,
        threads=threads,
        on_stage=lambda stage: on_progress(Progress(stage)),
    )
    return record, from_json(FieldMetrics, metrics, "metrics")


def errors_against_truth(model: Reconstruction, truth: Reconstruction) -> TruthErrors:
    """Pose errors after the similarity that brings the model into the frame of the truth (metres)."""
    comparison = align(model, truth)
    rotation_deg = np.rad2deg(comparison.rotation_error)
    focal = float(model.cameras[0].focal.mean() / truth.cameras[0].focal.mean() - 1.0)
    return TruthErrors(
        photos=len(comparison.names),
        rotation_error_mean_deg=float(rotation_deg.mean()),
        rotation_error_max_deg=float(rotation_deg.max()),
        position_error_mean_m=float(comparison.position_error.mean()),
        position_error_max_m=float(comparison.position_error.max()),
        focal_error_percent=100.0 * focal,
    )
