"""Training of the grid field: plan, stages with checkpoints, held-out views.

The clock starts before the photos are read and after the kernels are compiled (once per machine); it stops when
training ends.
"""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fieldstone.evaluate.image_metrics import quantize
from fieldstone.field.base.budget import Budget
from fieldstone.field.base.radiance_field import FieldTraining, in_world
from fieldstone.field.base.ray_dataset import RayDataset, reduced_size
from fieldstone.field.grid.exposure import gain_at
from fieldstone.geometry.camera import rescale
from fieldstone.io.images.photos import write_photo
from fieldstone.progress import OnProgress, Progress, StageProgress
from fieldstone.records.field import CurvePoint
from fieldstone.rendering.views import render_view
from fieldstone.run.checkpointing import TrainingCheckpoints, header_of
from fieldstone.run.evaluation import ExposureAt, evaluate
from fieldstone.run.field_input import check_sizes, dataset_of, decode_photos
from fieldstone.run.folder import RunFolder
from fieldstone.run.grid_planning import (
    StepsBy,
    compile_kernels,
    followed_plan,
    opened_training,
    planned,
    size_in_memory,
)
from fieldstone.run.grid_stages import PlannedState, train_stages
from fieldstone.run.network_training import torch_for
from fieldstone.run.options import TrainOptions, workers
from fieldstone.run.trained import Trained, TrainingInput

logger = logging.getLogger(__name__)

PREVIEW_SIZE_PX = 200
"""The first training view is shown at this size now and then."""

TIME_KEPT = 0.97
"""Fraction of the budget that is planned for: the last steps and the last checkpoint take what they take."""


def train_grid(given: TrainingInput, options: TrainOptions, out: RunFolder | None, on_progress: OnProgress) -> Trained:
    """Train a grid field on posed photos, render the held-out ones and measure them.

    Args:
        out: Where the training is kept, and taken up with its plan if it is already there, to the same bytes as without
            the stop.

    Raises:
        InputError: The photos, the plan or the device cannot be used, or `out` holds another field.
    """
    plan = followed_plan(out, options.plan)
    steps_by = steps_on(options.device)
    with ThreadPoolExecutor(workers(options.threads)) as executor:
        on_progress(Progress("compiling"))
        compile_kernels(executor, steps_by)
        budget = Budget.start(options.seconds)
        dataset, size_px = _training_photos(given, options, on_progress)
        opened = opened_training(dataset, plan, options, executor)
        if plan is None:
            opened = planned(opened, dataset, options, budget.part(TIME_KEPT), steps_by)
        training = steps_by(opened)
        header = header_of("fast", {"use_alpha": options.alpha}, options.seed, dataset)
        checkpoints = TrainingCheckpoints(out, header, dataset.train.posed.cam_from_world)
        state, curve = checkpoints.resume(training)
        before_s = curve[-1].seconds if curve else 0.0
        state, curve = _trained(
            training, state, curve, options, checkpoints, dataset, None if plan else budget, on_progress
        )
        seconds = before_s + budget.spent()
        test, _ = decode_photos(given.scene.photos.select(given.split.test), size_px)
        evaluation = evaluate(
            in_world(training.renderer(state), dataset.frame),
            test,
            dataset.frame.background,
            exposure_near(dataset, state),
            on_progress,
        )
        arrays = checkpoints.arrays(training.to_tensors(state))
    dataset = RayDataset(dataset.train, test, dataset.frame, dataset.points_in_world, dataset.bounded, dataset.seen)
    return Trained(header, arrays, curve, evaluation, dataset, seconds, state.step, state.plan)


def steps_on(device: str) -> StepsBy:
    """The steps of a training as they are on the CPU, and by torch on other devices.

    Raises:
        InputError: torch is not installed, or the device is not there.
    """
    if device == "cpu":
        return lambda training: training
    with torch_for(f"the fast field on {device}"):
        from fieldstone.field.grid_torch.training import TorchGridTraining
        from fieldstone.field.nerf.training import torch_device
    found = torch_device(device)
    logger.warning("training on %s: this way was tested on torch's CPU device only, never on a GPU", device)
    return lambda training: TorchGridTraining(training, found)


def exposure_near(dataset: RayDataset, state: PlannedState) -> ExposureAt | None:
    """The exposure that a held-out view is shown with, from the training photos near it; None: none was learned."""
    if state.plan.rates.exposure_rate == 0:
        return None
    log_gain = state.exposure.log_gain.astype(np.float64).reshape(-1, 3)
    poses = dataset.train.posed.cam_from_world
    return lambda cam_from_world: gain_at(log_gain, cam_from_world, poses)


def _training_photos(given: TrainingInput, options: TrainOptions, on_progress: OnProgress) -> tuple[RayDataset, int]:
    """The photos to learn from, decoded, and to what size they were reduced; the others are looked at."""
    on_progress(Progress("reading photos"))
    scene, split = given.scene, given.split
    size_px = options.size or size_in_memory(scene.photos.select(split.train), options.memory)
    check_sizes(scene.photos.select(split.test))
    return dataset_of(scene, split, size_px, held_out=False), size_px


def _trained(
    training: FieldTraining[PlannedState],
    state: PlannedState,
    curve: tuple[CurvePoint, ...],
    options: TrainOptions,
    checkpoints: TrainingCheckpoints,
    dataset: RayDataset,
    budget: Budget | None,
    on_progress: OnProgress,
) -> tuple[PlannedState, tuple[CurvePoint, ...]]:
    """The state at the end of its plan, kept and shown on the way."""
    stage = StageProgress(
        on_progress, "training", state.plan.schedule.total_steps if budget is None else budget.seconds
    )

    def show(point: CurvePoint) -> None:
        done = point.step if budget is None else budget.spent()
        stage.at(done, f"step {point.step}, training PSNR {point.psnr:.2f} dB")

    def preview(state: PlannedState) -> None:
        if checkpoints.out is None:
            return
        camera, pose = dataset.train.posed.camera_of(0), dataset.train.posed.pose_of(0)
        camera = rescale(camera, *reduced_size(camera.width, camera.height, PREVIEW_SIZE_PX))
        view = render_view(in_world(training.renderer(state), dataset.frame), camera, pose)
        write_photo(checkpoints.out.preview, quantize(view.rgb))

    def save(state: PlannedState, curve: tuple[CurvePoint, ...]) -> None:
        checkpoints.keep(training.to_tensors(state), curve, state.plan.to_json() + "\n")

    return train_stages(
        training,
        state,
        curve,
        budget=None if budget is None else budget.part(TIME_KEPT),
        max_steps=options.steps,
        on_step=show,
        save=save,
        preview=preview,
    )
