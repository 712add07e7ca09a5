"""A scene to a trained field, its held-out views measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone import __version__
from fieldstone.io.files.atomic import write_bytes
from fieldstone.progress import OnProgress, silent
from fieldstone.records.field import FieldMetrics
from fieldstone.report.figure_store import write_figures
from fieldstone.report.figures import field_figures
from fieldstone.report.page import Story
from fieldstone.run.field import Field
from fieldstone.run.field_input import holding_out, view_labels, with_masks
from fieldstone.run.folder import RunFolder
from fieldstone.run.grid_run import train_grid
from fieldstone.run.network_training import train_network
from fieldstone.run.options import TrainOptions, workers
from fieldstone.run.scene import Scene, open_scene
from fieldstone.run.trained import Trained, TrainingInput


def train(
    scene: Scene | str | Path,
    options: TrainOptions | None = None,
    *,
    keep_in: str | Path | None = None,
    report: bool = True,
    on_progress: OnProgress = silent,
    **settings: Any,
) -> Field:
    """A radiance field from posed photos, its held-out views rendered and measured.

    Args:
        scene: Of `reconstruct` or `open_scene`, or what `open_scene` opens.
        options: None: those that `settings` give.
        keep_in: Folder for the result: `checkpoint.safetensors`, `curve.json`, `metrics.json`, `renders/test` and the
            report. If it holds a checkpoint of the same photos and seed, training goes on from it, to the same bytes as
            without the stop. None: nothing is written.
        report: Whether to draw figures and page.
        on_progress: Hears how far every stage is.
        settings: Fields of `TrainOptions`, where no options are given.

    Raises:
        InputError: The photos or an option cannot be used, `keep_in` holds another field, or another process writes
            there.
    """
    options = options or TrainOptions(**settings)
    if keep_in is None:
        return train_into(None, scene, options, report=False, on_progress=on_progress)
    out = RunFolder(Path(keep_in))
    with out.sole_writer():
        return train_into(out, scene, options, report=report, on_progress=on_progress)


def train_into(
    out: RunFolder | None,
    scene: Scene | str | Path,
    options: TrainOptions,
    *,
    report: bool = True,
    on_progress: OnProgress = silent,
) -> Field:
    """`train` for who holds the folder already."""
    story = Story() if out is None else out.read_story()
    given = training_input(scene, options)
    train_kind = train_grid if options.field == "fast" else train_network
    trained = train_kind(given, options, out, on_progress)
    metrics = metrics_of(trained, options)
    if out is not None:
        _write_results(out, trained, metrics)
        if report:
            write_field_report(out, trained, replace(story, metrics=metrics, curve=trained.curve))
    return Field(trained.header, trained.tensors, trained.curve, metrics)


def training_input(scene: Scene | str | Path, options: TrainOptions) -> TrainingInput:
    """The posed photos of a scene, with masks, and which of them are held out.

    Raises:
        InputError: No photo has a pose, or an option names photos or masks that are not there.
    """
    opened = scene if isinstance(scene, Scene) else open_scene(scene, photos=options.photos)
    posed = opened.known_poses()
    split = holding_out(posed, options.hold_out)
    masks = opened.masks_folder if options.masks is None and options.field == "fast" else options.masks
    return TrainingInput(posed if masks is None else with_masks(posed, split, masks), split)


def metrics_of(trained: Trained, options: TrainOptions) -> FieldMetrics:
    """What `metrics.json` tells of a training."""
    evaluation = trained.evaluation
    return FieldMetrics(
        psnr=evaluation.psnr,
        ssim=evaluation.ssim,
        views=evaluation.scores,
        protocol=evaluation.protocol,
        seconds=trained.seconds,
        steps=trained.steps,
        field=options.field,
        device=options.device,
        threads=workers(options.threads),
        seed=options.seed,
        version=__version__,
        alpha=options.alpha if options.field == "fast" else None,
        plan=None if trained.plan is None else json.loads(trained.plan.to_json()),
    )


def _write_results(out: RunFolder, trained: Trained, metrics: FieldMetrics) -> None:
    """Held-out views and metrics; checkpoint, curve and plan were written while the field learned."""
    for label, png in trained.evaluation.views.items():
        write_bytes(out.held_out_views / f"{label}.png", png)
    out.write_metrics(metrics)


def write_field_report(out: RunFolder, trained: Trained, story: Story) -> None:
    """Add the training curve and rendered beside true views to the report of the folder."""
    test, background = trained.dataset.test, trained.dataset.frame.background
    photo_of_label = {label: v for v, label in enumerate(view_labels(test.posed.names))}

    def true_view(label: str) -> np.ndarray:
        return np.rint(255.0 * test.composited(photo_of_label[label], background)).astype(np.uint8)

    figures = field_figures(trained.curve, trained.evaluation.view, true_view, trained.evaluation.scores)
    write_figures(out.figures, "field", figures)
    out.write_report(story)
