"""Training of the classical networks: the original NeRF and the small one of the course."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from fieldstone.errors import InputError
from fieldstone.field.base.budget import Budget
from fieldstone.field.base.radiance_field import FieldFrame, FieldTraining, in_world
from fieldstone.field.base.ray_dataset import RayDataset, training_rays
from fieldstone.field.base.training import PRESETS, NetworkOptions, train
from fieldstone.progress import OnProgress, Progress, StageProgress
from fieldstone.records.field import CurvePoint
from fieldstone.run.checkpointing import TrainingCheckpoints, header_of
from fieldstone.run.evaluation import evaluate
from fieldstone.run.field_input import dataset_of
from fieldstone.run.folder import RunFolder
from fieldstone.run.options import TrainOptions, workers
from fieldstone.run.trained import Trained, TrainingInput


@contextmanager
def torch_for(what: str) -> Iterator[None]:
    """Imports within need torch.

    Raises:
        InputError: It is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise InputError(
            f"{what} needs torch: pip install 'fieldstone[torch]' "
            "(without a GPU, from the index https://download.pytorch.org/whl/cpu)"
        ) from error


@contextmanager
def open_training(
    options: NetworkOptions, frame: FieldFrame, dataset: RayDataset | None, *, seed: int, device: str, threads: int
) -> Iterator[FieldTraining[Any]]:
    """The training of a network, with its worker threads; without a dataset it can only render.

    Raises:
        InputError: torch is not installed, or the device is not there.
    """
    with torch_for(f"the {options.network} network"):
        from fieldstone.field.nerf.training import TorchTraining, torch_device, torch_workers
    rays = None if dataset is None else training_rays(dataset.train, frame)
    with torch_workers(threads) as pool:
        yield TorchTraining(options, frame, rays, seed, torch_device(device), pool)


def train_network(
    given: TrainingInput, options: TrainOptions, out: RunFolder | None, on_progress: OnProgress
) -> Trained:
    """Train a network on posed photos, render the held-out ones and measure them.

    Args:
        out: Where the training is kept, and taken up if it is already there.

    Raises:
        InputError: The photos cannot be used, torch is missing, or `out` holds another field.
    """
    network, budget_s = PRESETS[options.field], None if options.budget_s is None and options.steps else options.seconds
    on_progress(Progress("reading photos"))
    dataset = dataset_of(given.scene, given.split, network.image_size_px)
    header = header_of(options.field, asdict(network), options.seed, dataset)
    checkpoints = TrainingCheckpoints(out, header, dataset.train.posed.cam_from_world)
    with open_training(
        network, dataset.frame, dataset, seed=options.seed, device=options.device, threads=workers(options.threads)
    ) as training:
        state, curve = checkpoints.resume(training)
        before_s = curve[-1].seconds if curve else 0.0
        stage = StageProgress(on_progress, "training", budget_s or options.steps)

        def show(point: CurvePoint) -> None:
            done = point.step if budget_s is None else point.seconds
            stage.at(done, f"step {point.step}, training PSNR {point.psnr:.2f} dB")

        state, curve = train(
            training,
            state,
            budget=Budget.start(None if budget_s is None else budget_s - before_s),
            max_steps=options.steps,
            curve=curve,
            on_step=show,
            save=lambda state, curve: checkpoints.keep(training.to_tensors(state), curve),
        )
        tensors = training.to_tensors(state)
        evaluation = evaluate(
            in_world(training.renderer(state), dataset.frame),
            dataset.test,
            dataset.frame.background,
            on_progress=on_progress,
        )
    seconds = curve[-1].seconds if curve else 0.0
    return Trained(header, checkpoints.arrays(tensors), curve, evaluation, dataset, seconds, len(curve))
