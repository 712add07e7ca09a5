"""Posed photos to a fast field within a time budget: plan, training with checkpoints, held-out views.

The clock starts before the photos are read and after the kernels are compiled (once per machine); it stops when
training ends.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone import __version__
from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import quantize
from fieldstone.field.base.radiance_field import FieldFrame, FieldTraining, in_world
from fieldstone.field.base.ray_dataset import RayDataset, reduced_size
from fieldstone.field.base.training import CurvePoint, OnStep
from fieldstone.field.grid.exposure import gain_at
from fieldstone.field.grid_training.budget import finest_for, first_plan, plan_for_budget
from fieldstone.field.grid_training.plan import NUM_STAGES, GridPlan, Schedule, plan_from_json
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.io.files.atomic import write_json, write_text
from fieldstone.io.files.checkpoint import write_checkpoint
from fieldstone.io.images.photos import write_photo
from fieldstone.render.views import render_view
from fieldstone.run.fast_stages import PlannedState, measured_step, train_stages
from fieldstone.run.field_input import (
    check_sizes,
    dataset_of,
    decode_photos,
    holding_out,
    open_field_input,
    with_masks,
)
from fieldstone.run.fields import (
    CHECKPOINT,
    CURVE,
    METRICS,
    evaluate_views,
    prefixed,
    resume_or_start,
    run_header,
    scene_tensors,
    torch_for,
    write_field_report,
)
from fieldstone.scene.photos import DecodedPhotos, PosedPhotos, posed_photos
from fieldstone.scene.rays import rays_from_view

logger = logging.getLogger(__name__)

PLAN, PREVIEW = "plan.json", "preview.png"

PREVIEW_SIZE_PX = 200
"""The first training view is shown at this size now and then."""

MAX_SIZE_PX, LEAST_SIZE_PX = 4096, 200
"""Photos are reduced to a length of their longer side between these, as memory allows."""

TIME_KEPT = 0.97
"""Share of the budget that is planned for: the last steps and the last checkpoint take what they take."""


StepsBy = Callable[[GridTraining], FieldTraining[Any]]
"""Who does the steps of a training."""


def train_fast_run(
    source: Path,
    out: Path,
    *,
    budget_s: float = 60.0,
    max_steps: int | None = None,
    plan: Path | None = None,
    use_alpha: bool = True,
    memory_gib: float = 4.0,
    seed: int = 0,
    threads: int | None = None,
    photos: Path | None = None,
    masks: Path | None = None,
    size_px: int | None = None,
    refine_poses: bool = False,
    hold_out: Sequence[str] | None = None,
    device: str = "cpu",
    on_step: OnStep = lambda point: None,
    on_stage: Callable[[str], None] = lambda stage: None,
) -> dict[str, Any]:
    """Train a fast field on posed photos, render the held-out ones and measure them.

    If `out` holds a checkpoint of the same photos and seed, training goes on with its plan, to the same bytes as
    without the stop.

    Args:
        source: Anything that `field_input.open_field_input` reads.
        budget_s: Seconds for reading and training.
        max_steps: Stop after so many steps of the plan.
        plan: The plan.json of another run, to be followed to the letter; the budget is then ignored.
        use_alpha: False takes photos with alpha as photos on the background.
        memory_gib: What grids and rays may take; the finest grid is chosen to fit.
        masks: Folder with masks of the photos; nothing is learned where they are black, nor measured. None: those of
            the reconstruction, if it had some.
        size_px: Photos are reduced to this length of their longer side; None: to what fits, see `size_in_memory`.
        refine_poses: Move the training photos so that the field fits them, held by known points. Held-out photos stay.
        hold_out: Photos to measure with instead of the default, see `field_input.holding_out`.
        device: Where steps are computed: cpu, or a device of torch, see `grid_torch.training`. Equal plans then give
            equal fields to rounding only. Rendering stays on the CPU.

    Returns:
        What `metrics.json` holds.

    Raises:
        InputError: The source, the plan or the device cannot be used, or `out` holds another field.
    """
    if not budget_s > 0:
        raise InputError(f"a budget must be positive, got {budget_s:g} s; say for example --budget 60s")
    threads = threads or os.cpu_count() or 1
    given = followed_plan(out, None if plan is None else _read_plan(plan))
    steps_by = steps_on(device)
    with ThreadPoolExecutor(threads) as executor:
        on_stage("compiling")
        compile_kernels(executor, steps_by)
        started = time.perf_counter()
        on_stage("reading photos")
        scene = open_field_input(source, photos)
        split = holding_out(scene, hold_out)
        scene = with_masks(scene, split, masks, source)
        size_px = size_px or size_in_memory(scene.photos.select(split.train), memory_gib)
        check_sizes(scene.photos.select(split.test))
        dataset = dataset_of(scene, split, size_px, held_out=False)
        header = run_header("fast", {"use_alpha": use_alpha}, seed, dataset)
        opened = _open(dataset, given, budget_s, use_alpha, refine_poses, seed, executor, memory_gib)
        if given is None:
            spent = time.perf_counter() - started
            seconds_per_step = measured_step(steps_by(opened))
            opened = replace(opened, plan=plan_for_budget(opened.plan, TIME_KEPT * budget_s, spent, seconds_per_step))
        training = steps_by(opened)
        state, curve = resume_or_start(training, out, header)
        trained_before = curve[-1].seconds if curve else 0.0
        views = scene_tensors(dataset.train.posed.cam_from_world)

        def save(state: PlannedState, curve: tuple[CurvePoint, ...]) -> None:
            write_json(out / CURVE, [asdict(point) for point in curve])
            write_text(out / PLAN, state.plan.to_json() + "\n")
            write_checkpoint(out / CHECKPOINT, {**views, **prefixed(training.to_tensors(state))}, header)

        def preview(state: PlannedState) -> None:
            camera, pose = dataset.train.posed.camera_of(0), dataset.train.posed.pose_of(0)
            camera = rescale(camera, *reduced_size(camera.width, camera.height, PREVIEW_SIZE_PX))
            view = render_view(in_world(training.renderer(state), dataset.frame), camera, pose)
            write_photo(out / PREVIEW, quantize(view.rgb))

        on_stage("training")
        deadline = None if given is not None else started + TIME_KEPT * budget_s
        state, curve = train_stages(
            training, state, curve, deadline=deadline, max_steps=max_steps, on_step=on_step, save=save, preview=preview
        )
        elapsed = time.perf_counter() - started
        on_stage("rendering held-out views")
        dataset = replace(dataset, test=decode_photos(scene.photos.select(split.test), size_px)[0])
        shown = in_world(training.renderer(state), dataset.frame)
        metrics = evaluate_views(shown, dataset, out / "renders" / "test", exposure_near(dataset, state))
    metrics |= {
        "seconds": elapsed + trained_before,
        "steps": state.step,
        "field": "fast",
        "alpha": use_alpha,
        "plan": state.plan.to_settings(),
        "device": device,
        "threads": threads,
        "seed": seed,
        "version": __version__,
    }
    write_json(out / METRICS, metrics)
    write_field_report(out, dataset, curve, metrics)
    return metrics


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


def exposure_near(dataset: RayDataset, state: PlannedState) -> Callable[[Rigid3], np.ndarray] | None:
    """The exposure that a held-out view is shown with, from the training photos near it; None: none was learned."""
    if state.plan.rates.exposure_rate == 0:
        return None
    log_gain = state.exposure.log_gain.astype(np.float64).reshape(-1, 3)
    return lambda cam_from_world: gain_at(log_gain, cam_from_world, dataset.train.posed.cam_from_world)


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


def _open(
    dataset: RayDataset,
    given: GridPlan | None,
    budget_s: float,
    use_alpha: bool,
    refine_poses: bool,
    seed: int,
    executor: Executor,
    memory_gib: float = 4.0,
) -> GridTraining:
    """The training of a dataset, with the given plan or a provisional one."""
    provisional = given or first_plan(64, budget_s, bounded=True)
    training = prepare_grid_training(
        dataset.train,
        dataset.frame,
        provisional,
        seed=seed,
        executor=executor,
        use_alpha=use_alpha,
        points_in_world=dataset.points_in_world,
        seen=dataset.seen,
        bounded=dataset.bounded,
        refine_poses=given.schedule.refine_poses if given is not None else refine_poses,
    )
    if given is not None:
        return training
    world = dataset.frame.normalized_from_world
    posed = dataset.train.posed
    distances = [np.linalg.norm(world.apply(center)) for center in posed.centers()]
    focal = float(np.median([np.mean(posed.camera_of(v).focal) for v in range(len(posed))]))
    extent = float(np.max(training.occupancy.extent))
    pixel_size = float(np.median(distances) / focal)
    if training.space.is_projective:
        pixel_size = 1.0 / focal
    finest = finest_for(budget_s, extent, pixel_size)
    if training.space.is_contracted:
        finest = min(2 * finest, MAX_UNBOUNDED)
    finest = min(finest, _finest_in_memory(training, sum(p.nbytes for p in dataset.train.pixels), memory_gib))
    plan = first_plan(finest, budget_s, bounded=not training.space.is_open)
    return replace(training, plan=plan.replaced(refine_poses=refine_poses))


def size_in_memory(photos: PosedPhotos, memory_gib: float) -> int:
    """Pixels along the longer side of the photos whose rays leave room for grids."""
    cameras = [photos.camera_of(v) for v in range(len(photos))]
    pixels = sum(camera.width * camera.height for camera in cameras)
    share = RAYS_SHARE * memory_gib * 2**30 / (BYTES_PER_PIXEL * max(pixels, 1))
    longest = max((max(camera.width, camera.height) for camera in cameras), default=MAX_SIZE_PX)
    size = min(MAX_SIZE_PX, longest, max(int(longest * min(share, 1.0) ** 0.5), LEAST_SIZE_PX))
    if size < longest:
        logger.info("photos are reduced to %d pixels, so that rays and grids fit %g GiB", size, memory_gib)
    return size


def _finest_in_memory(training: GridTraining, photo_bytes: int, memory_gib: float) -> int:
    """Cells along the longest side whose grids fit beside the photos and their rays.

    A vertex of the finest level has 32 bytes of values and velocities, all coarser levels add a seventh and their
    gradients; growing by a level needs the old values once more.

    Raises:
        InputError: Not even the coarsest grids fit.
    """
    rays = training.rays
    used = sum(array.nbytes for array in (rays.image, rays.bearing, rays.rgba, rays.bearings, rays.free_distance))
    used += photo_bytes
    left = memory_gib * 2**30 - used
    extent = training.occupancy.extent / np.max(training.occupancy.extent)
    finest = int(np.cbrt(max(left, 0.0) / (BYTES_PER_VERTEX * np.prod(extent))))
    if finest < MIN_FINEST:
        raise InputError(
            f"--memory {memory_gib:g}: the rays of the photos take {used / 2**30:.2f} GiB and leave no room for grids; "
            "give more memory or smaller photos"
        )
    return finest


BYTES_PER_VERTEX, MIN_FINEST = 48, 16

BYTES_PER_PIXEL, RAYS_SHARE = 36, 0.75
"""Bytes that a pixel and its ray take while the table of rays is made, and the share of the memory for them."""

MAX_UNBOUNDED = 256
"""As `plan.MAX_FINEST`, for a box of which nearly all cells may be used."""


def followed_plan(out: Path, given: GridPlan | None) -> GridPlan | None:
    """The plan that is followed to the letter: of the run that `out` holds, else the given one, if there is one.

    Raises:
        InputError: The given plan is not that of the run in `out`.
    """
    if not (out / CHECKPOINT).exists() or not (out / PLAN).exists():
        return given
    stored = _read_plan(out / PLAN)
    if given is not None and given.replaced(stop_after=None) != stored.replaced(stop_after=None):
        raise InputError(f"{out}: holds a run of another plan than --plan; leave it out, or choose another folder")
    return stored


def _read_plan(path: Path) -> GridPlan:
    try:
        return plan_from_json(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a plan.json of a fast field ({error})") from error
