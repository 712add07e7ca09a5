"""What a time budget and a memory limit buy for the grid field: its plan, its resolution, the size of the photos."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone.errors import InputError
from fieldstone.field.base.budget import Budget
from fieldstone.field.base.radiance_field import FieldFrame, FieldTraining
from fieldstone.field.base.ray_dataset import RayDataset
from fieldstone.field.grid_training.budget import finest_for, first_plan, plan_for_budget
from fieldstone.field.grid_training.plan import NUM_STAGES, GridPlan, Schedule, plan_from_json
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.run.folder import RunFolder
from fieldstone.run.grid_stages import measured_step
from fieldstone.run.options import TrainOptions
from fieldstone.scene.photos import DecodedPhotos, PosedPhotos, posed_photos
from fieldstone.scene.rays import rays_from_view

logger = logging.getLogger(__name__)

MAX_SIZE_PX, LEAST_SIZE_PX = 4096, 200
"""Photos are reduced to a length of their longer side between these, as memory allows."""

BYTES_PER_PIXEL, RAYS_FRACTION = 36, 0.75
"""Bytes that a pixel and its ray take while the table of rays is made, and the fraction of the memory for them."""

BYTES_PER_VERTEX, MIN_FINEST = 48, 16
"""A vertex of the finest level has 32 bytes of values and second moments, all coarser levels add a seventh and their
gradients; growing by a level needs the old values once more."""

MAX_OPEN_FINEST = 256
"""Cells along the longest side of a space that reaches to infinity, of which nearly all may be used."""

StepsBy = Callable[[GridTraining], FieldTraining[Any]]
"""Who does the steps of a training."""


def followed_plan(out: RunFolder | None, given: Path | None) -> GridPlan | None:
    """The plan that is followed to the letter: of the run that `out` holds, else the given one, if there is one.

    Raises:
        InputError: A plan cannot be read, or the given one is not that of the run in `out`.
    """
    asked = None if given is None else _read_plan(given)
    if out is None or not out.checkpoint.exists() or not out.plan.exists():
        return asked
    stored = _read_plan(out.plan)
    if asked is not None and asked.replaced(stop_after=None) != stored.replaced(stop_after=None):
        raise InputError(f"{out.path}: holds a run of another plan than `plan`; leave it out, or choose another folder")
    return stored


def size_in_memory(photos: PosedPhotos, memory_gib: float) -> int:
    """Pixels along the longer side of the photos whose rays leave room for grids."""
    cameras = [photos.camera_of(v) for v in range(len(photos))]
    pixels = sum(camera.width * camera.height for camera in cameras)
    fraction = RAYS_FRACTION * memory_gib * 2**30 / (BYTES_PER_PIXEL * max(pixels, 1))
    longest = max((max(camera.width, camera.height) for camera in cameras), default=MAX_SIZE_PX)
    size = min(MAX_SIZE_PX, longest, max(int(longest * min(fraction, 1.0) ** 0.5), LEAST_SIZE_PX))
    if size < longest:
        logger.info("photos are reduced to %d pixels, so that rays and grids fit %g GiB", size, memory_gib)
    return size


def opened_training(
    dataset: RayDataset, plan: GridPlan | None, options: TrainOptions, executor: Executor
) -> GridTraining:
    """The training of a dataset by a plan; without one, by a provisional one for `planned`."""
    return prepare_grid_training(
        dataset.train,
        dataset.frame,
        plan or first_plan(64, options.seconds, bounded=True),
        seed=options.seed,
        executor=executor,
        use_alpha=options.alpha,
        points_in_world=dataset.points_in_world,
        seen=dataset.seen,
        bounded=dataset.bounded,
        refine_poses=options.refine_poses if plan is None else plan.schedule.refine_poses,
    )


def planned(
    training: GridTraining, dataset: RayDataset, options: TrainOptions, budget: Budget, steps_by: StepsBy
) -> GridTraining:
    """The training with the grids and steps that fit into budget and memory; some steps are tried, and thrown away."""
    finest = min(
        _finest_in_budget(training, dataset, options.seconds), _finest_in_memory(training, dataset, options.memory)
    )
    plan = first_plan(finest, options.seconds, bounded=not training.space.is_open)
    training = replace(training, plan=plan.replaced(refine_poses=options.refine_poses))
    spent_s, seconds_per_step = budget.spent(), measured_step(steps_by(training))
    return replace(training, plan=plan_for_budget(training.plan, budget.seconds, spent_s, seconds_per_step))


def compile_kernels(executor: Executor, steps_by: StepsBy = lambda training: training) -> None:
    """Run every kernel once, so that what follows measures the machine and not the compiler."""
    camera = Camera("SIMPLE_PINHOLE", 12, 12, np.array([14.0, 6.0, 6.0]))
    pixels = np.full((12, 12, 4), 255, dtype=np.uint8)
    pixels[:3], pixels[:, :3] = 0, 0
    pose = Rigid3(np.eye(3), np.array([0.0, 0, 4]))
    posed = posed_photos(["compile"], [camera], np.zeros(1, dtype=np.int64), Rigid3.stack([pose]))
    photos = DecodedPhotos(posed, (pixels,), (None,))
    frame = FieldFrame(Sim3(1.0, np.eye(3), np.zeros(3)), 2.0, 6.0, np.ones(3))
    plan = GridPlan(Schedule(finest=64, steps=(1,) * NUM_STAGES)).replaced(num_chunks=1, samples_per_chunk=256)
    training = steps_by(prepare_grid_training(photos, frame, plan, seed=0, executor=executor))
    state = training.start()
    for _ in range(plan.schedule.total_steps):
        state, _ = training.advance(state)
    training.renderer(state)(rays_from_view(camera, pose))


def _finest_in_budget(training: GridTraining, dataset: RayDataset, budget_s: float) -> int:
    """Cells along the longest side that are worth their time."""
    posed, world = dataset.train.posed, dataset.frame.normalized_from_world
    distances = [np.linalg.norm(world.apply(center)) for center in posed.centers()]
    focal = float(np.median([np.mean(posed.camera_of(v).focal) for v in range(len(posed))]))
    pixel_size = 1.0 / focal if training.space.is_projective else float(np.median(distances) / focal)
    finest = finest_for(budget_s, float(np.max(training.occupancy.extent)), pixel_size)
    return min(2 * finest, MAX_OPEN_FINEST) if training.space.is_contracted else finest


def _finest_in_memory(training: GridTraining, dataset: RayDataset, memory_gib: float) -> int:
    """Cells along the longest side whose grids fit beside the photos and their rays.

    Raises:
        InputError: Not even the coarsest grids fit.
    """
    rays = training.rays
    used = sum(array.nbytes for array in (rays.image, rays.bearing, rays.rgba, rays.bearings, rays.free_distance))
    used += sum(pixels.nbytes for pixels in dataset.train.pixels)
    left = memory_gib * 2**30 - used
    extent = training.occupancy.extent / np.max(training.occupancy.extent)
    finest = int(np.cbrt(max(left, 0.0) / (BYTES_PER_VERTEX * np.prod(extent))))
    if finest < MIN_FINEST:
        raise InputError(
            f"`memory` {memory_gib:g}: the rays of the photos take {used / 2**30:.2f} GiB and leave no room for grids; "
            "give more memory or smaller photos"
        )
    return finest


def _read_plan(path: Path) -> GridPlan:
    try:
        return plan_from_json(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a plan.json of a fast field ({error})") from error
