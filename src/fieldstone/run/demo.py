"""The whole road on photos that the package makes itself, and what it misses the truth by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fieldstone.progress import OnProgress, Progress, silent
from fieldstone.records.mapping import TruthErrors
from fieldstone.run.field import Field
from fieldstone.run.folder import RunFolder
from fieldstone.run.options import DemoOptions, TrainOptions, workers
from fieldstone.run.reconstruct import reconstructed
from fieldstone.run.reconstruct_options import ReconstructOptions
from fieldstone.run.scene import Scene, write_scene
from fieldstone.run.train import train_into
from fieldstone.scene.alignment import align
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.synthetic.photos import PhotoOptions, make_photos, write_photos


@dataclass(frozen=True, eq=False)
class Demo:
    """What the road led to, and what it misses the truth by."""

    scene: Scene
    field: Field | None
    """None without a model."""


def run_demo(
    out: str | Path,
    options: DemoOptions | None = None,
    *,
    photo_options: PhotoOptions | None = None,
    on_progress: OnProgress = silent,
) -> Demo:
    """Photograph a synthetic house, reconstruct it, train a field on it, and compare with the truth.

    Everything goes to `out`: `photos/`, what `reconstruct` writes, what `train` writes, one report.

    Raises:
        InputError: Another process writes to `out`, or it cannot be written.
    """
    options, photo_options = options or DemoOptions(), photo_options or PhotoOptions()
    folder = RunFolder(Path(out))
    with folder.sole_writer() as cache:
        on_progress(Progress("photographing a house"))
        rng = np.random.default_rng(options.seed)
        photos = make_photos(photo_options, rng, threads=workers(options.threads))
        write_photos(photos, folder.photos, photo_options)
        reconstruct_options = ReconstructOptions(threads=options.threads, seed=options.seed)
        scene = reconstructed(folder.photos, reconstruct_options, cache, on_progress)
        if not scene.summary.registered:
            return Demo(write_scene(scene, folder), None)
        scene = write_scene(with_truth(scene, photos.truth), folder)
        train_options = TrainOptions(budget_s=options.budget_s, threads=options.threads, seed=options.seed)
        return Demo(scene, train_into(folder, scene, train_options, on_progress=on_progress))


def with_truth(scene: Scene, truth: Reconstruction) -> Scene:
    """The scene with what its model misses the truth by."""
    assert scene.record is not None
    return replace(scene, record=replace(scene.record, truth=errors_against_truth(scene.model, truth)))


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
