"""Posed photos to a trained field: dataset, training with checkpoints, held-out views and their metrics.

What a run leaves in its folder: `checkpoint.safetensors` (all that rendering and resuming need), `curve.json`,
`metrics.json` and `renders/test/NAME.png`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fieldstone import __version__
from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import PROTOCOL, psnr, quantize, ssim
from fieldstone.field.base.radiance_field import FieldFrame, FieldTraining, RayRenderer, in_world
from fieldstone.field.base.ray_dataset import RayDataset, training_rays
from fieldstone.field.base.training import PRESETS, CurvePoint, OnStep, TrainOptions, train
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.io.files.atomic import write_json
from fieldstone.io.files.checkpoint import read_checkpoint, write_checkpoint
from fieldstone.io.images.photos import read_photo, write_photo
from fieldstone.records.field import FieldMetrics
from fieldstone.records.files import from_json
from fieldstone.render.views import render_view
from fieldstone.report.figure_store import write_figures
from fieldstone.report.figures import field_figures
from fieldstone.report.page import Story
from fieldstone.run.field_input import read_ray_dataset, view_labels
from fieldstone.run.folder import RunFolder

logger = logging.getLogger(__name__)

FieldName = Literal["tiny", "nerf"]

CHECKPOINT, CURVE, METRICS = "checkpoint.safetensors", "curve.json", "metrics.json"

MAX_PSNR = 100.0
"""What an image that is equal at 8 bits counts as, in dB: JSON has no infinity."""

OnStage = Callable[[str], None]


def train_run(
    source: Path,
    out: Path,
    *,
    field: FieldName = "tiny",
    budget_s: float | None = 300.0,
    max_steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
    photos: Path | None = None,
    hold_out: Sequence[str] | None = None,
    on_step: OnStep = lambda point: None,
    on_stage: OnStage = lambda stage: None,
) -> dict[str, Any]:
    """Train a field on posed photos, render the held-out ones and measure them.

    If `out` holds a checkpoint of the same field, photos and seed, training goes on from it, to the same result as
    without the stop.

    Args:
        source: A Blender-format folder, or one that `reconstruct` wrote.
        budget_s: Seconds of training in all, those before a stop included; None: no limit.
        max_steps: Steps in all; None: no limit.
        threads: None: one per processor.
        photos: Folder with the photos of a reconstruction, if they are not where they were.
        hold_out: Photos to measure with instead of the default, see `field_input.holding_out`.

    Returns:
        What `metrics.json` holds.

    Raises:
        InputError: The source cannot be used, or `out` holds another field.
    """
    on_stage("reading photos")
    options = PRESETS[field]
    dataset = read_ray_dataset(source, photos, options.image_size_px, hold_out=hold_out)
    header = run_header(field, asdict(options), seed, dataset)
    threads = threads or os.cpu_count() or 1
    with open_training(options, dataset.frame, dataset, seed=seed, device=device, threads=threads) as training:
        state, curve = resume_or_start(training, out, header)
        on_stage("training")
        views = scene_tensors(dataset.train.posed.cam_from_world)

        def save(state: Any, curve: tuple[CurvePoint, ...]) -> None:
            # The curve first: after a stop between the two it holds steps too many, which are dropped.
            write_json(out / CURVE, [asdict(point) for point in curve])
            write_checkpoint(out / CHECKPOINT, {**views, **prefixed(training.to_tensors(state))}, header)

        state, curve = train(
            training, state, budget_s=budget_s, max_steps=max_steps, curve=curve, on_step=on_step, save=save
        )
        on_stage("rendering held-out views")
        render_rays = in_world(training.renderer(state), dataset.frame)
        metrics = evaluate_views(render_rays, dataset, out / "renders" / "test")
    metrics |= {
        "seconds": curve[-1].seconds if curve else 0.0,
        "steps": len(curve),
        "field": field,
        "device": device,
        "threads": threads,
        "seed": seed,
        "version": __version__,
    }
    write_json(out / METRICS, metrics)
    write_field_report(out, dataset, curve, metrics)
    return metrics


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
    options: TrainOptions, frame: FieldFrame, dataset: RayDataset | None, *, seed: int, device: str, threads: int
) -> Iterator[FieldTraining[Any]]:
    """The training of a field, with its worker threads; without a dataset it can only render.

    Raises:
        InputError: torch is not installed, or the device is not there.
    """
    with torch_for(f"the {options.network} network"):
        from fieldstone.field.nerf.training import TorchTraining, torch_device, torch_workers
    rays = None if dataset is None else training_rays(dataset.train, frame)
    with torch_workers(threads) as workers:
        yield TorchTraining(options, frame, rays, seed, torch_device(device), workers)


def evaluate_views(
    render_rays: RayRenderer,
    dataset: RayDataset,
    folder: Path,
    exposure: Callable[[Rigid3], np.ndarray] | None = None,
) -> dict[str, Any]:
    """Render every held-out view to `folder`/NAME.png, and compare it with its photo, where its mask is white.

    Args:
        exposure: Gain of each channel with which a view from a pose (`cam_from_world`) is shown; None: 1.
    """
    views: dict[str, dict[str, float]] = {}
    photos = dataset.test
    for v, label in enumerate(view_labels(photos.posed.names)):
        pose, keep = photos.posed.pose_of(v), photos.keep[v]
        color = render_view(render_rays, photos.posed.camera_of(v), pose).rgb
        rendered = quantize(color if exposure is None else color * exposure(pose))
        write_photo(folder / f"{label}.png", rendered)
        photo = photos.composited(v, dataset.frame.background)
        as_written = rendered.astype(np.float32) / np.float32(255.0)
        if keep is not None:
            as_written = np.where(keep[..., None], as_written, photo)
        share = 1.0 if keep is None else max(float(keep.mean()), 1e-9)
        # Equal pixels where the mask is black count nothing: the mean is over the others.
        found = psnr(as_written, photo) + 10.0 * np.log10(share)
        views[label] = {"psnr": float(min(found, MAX_PSNR)), "ssim": float(ssim(as_written, photo))}
    sizes = sorted({(camera.width, camera.height) for camera in photos.posed.cameras})
    background = ", ".join(f"{255 * c:.0f}" for c in dataset.frame.background)
    masked = any(keep is not None for keep in photos.keep)
    return {
        "psnr": float(np.mean([view["psnr"] for view in views.values()])) if views else None,
        "ssim": float(np.mean([view["ssim"] for view in views.values()])) if views else None,
        "views": views,
        "protocol": (
            f"{len(views)} held-out views of {' and '.join(f'{w}x{h}' for w, h in sizes) or 'no'} pixels; "
            f"background ({background}); {PROTOCOL}; equal images count as {MAX_PSNR:.0f} dB"
            + ("" if exposure is None else "; shown with the exposure of the training photos nearest to them")
            + ("; only where masks are white" if masked else "")
        ),
    }


def write_field_report(out: Path, dataset: RayDataset, curve: Sequence[CurvePoint], metrics: Mapping[str, Any]) -> None:
    """Add the training curve and rendered beside true views to the report of the folder."""
    index = {label: v for v, label in enumerate(view_labels(dataset.test.posed.names))}
    found = from_json(FieldMetrics, metrics, METRICS)
    figures = field_figures(
        curve,
        lambda label: read_photo(out / "renders" / "test" / f"{label}.png").rgb,
        lambda label: np.rint(255.0 * dataset.test.composited(index[label], dataset.frame.background)).astype(np.uint8),
        found.views,
    )
    folder = RunFolder(out)
    write_figures(folder.figures, "field", figures)
    folder.write_report(Story(folder.read_run(), found, curve))


def run_header(field: str, options: Mapping[str, Any], seed: int, dataset: RayDataset) -> dict[str, Any]:
    """What a checkpoint says of its run; equal headers mean that training can go on."""
    frame, posed = dataset.frame, dataset.train.posed
    return {
        "field": field,
        "options": dict(options),
        "seed": seed,
        "photos": fingerprint(dataset),
        "frame": {
            "scale": frame.normalized_from_world.scale,
            "R": frame.normalized_from_world.R.tolist(),
            "t": frame.normalized_from_world.t.tolist(),
            "near": frame.near,
            "far": frame.far,
            "background": frame.background.tolist(),
        },
        "names": list(posed.names),
        "cameras": [
            {"model": c.model, "width": c.width, "height": c.height, "params": c.params.tolist()} for c in posed.cameras
        ],
        "camera_of_view": posed.camera_of_photo.tolist(),
    }


def fingerprint(dataset: RayDataset) -> str:
    """SHA-256 of the training photos as they are used, with names and poses."""
    digest = hashlib.sha256()
    photos, posed = dataset.train, dataset.train.posed
    for v, name in enumerate(posed.names):
        digest.update(f"{name}\n{photos.pixels[v].shape}\n".encode())
        arrays = [photos.pixels[v], posed.camera_of(v).params, posed.pose_of(v).R, posed.pose_of(v).t]
        keep, seen = photos.keep[v], dataset.seen[v] if dataset.seen else None
        arrays += [] if keep is None else [keep]
        arrays += [] if seen is None else [seen.xyz, seen.sigma]
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def scene_tensors(cam_from_world: Rigid3) -> dict[str, np.ndarray]:
    """Poses of the training views, for camera paths."""
    return {"views.R": cam_from_world.R, "views.t": cam_from_world.t}


def frame_from_header(header: Mapping[str, Any]) -> FieldFrame:
    """The frame of a checkpoint."""
    frame = header["frame"]
    sim3 = Sim3(frame["scale"], np.array(frame["R"]), np.array(frame["t"]))
    return FieldFrame(sim3, frame["near"], frame["far"], np.array(frame["background"]))


def split_tensors(tensors: Mapping[str, np.ndarray]) -> tuple[Rigid3, dict[str, np.ndarray]]:
    """Poses of the training views, as refined if they were, and the state of the field, of a checkpoint."""
    state = {name.removeprefix("state."): array for name, array in tensors.items() if name.startswith("state.")}
    poses = Rigid3(tensors["views.R"], tensors["views.t"])
    moved = state.get("moved")
    return (poses if moved is None or not moved.any() else poses.retract(moved)), state


def prefixed(tensors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The state of a field under the names that it has in a checkpoint."""
    return {f"state.{name}": array for name, array in tensors.items()}


def resume_or_start(
    training: FieldTraining[Any], out: Path, header: Mapping[str, Any]
) -> tuple[Any, tuple[CurvePoint, ...]]:
    """The state and curve of the checkpoint in `out`, or of the start.

    Raises:
        InputError: `out` holds another field, or a damaged one.
    """
    if not (out / CHECKPOINT).exists():
        return training.start(), ()
    tensors, found = read_checkpoint(out / CHECKPOINT)
    other = [key for key in header if found.get(key) != header[key]]
    if other:
        raise InputError(
            f"{out}: holds a field of another run (differs in: {', '.join(other)}); choose another output folder"
        )
    _, state_tensors = split_tensors(tensors)
    state = training.from_tensors(state_tensors)
    curve = _read_curve(out / CURVE)[: int(state_tensors["step"])]
    if len(curve) < int(state_tensors["step"]):
        raise InputError(f"{out / CURVE}: holds fewer steps than the checkpoint; train into a new folder")
    logger.info("going on after step %d, %.1f s", len(curve), curve[-1].seconds if curve else 0.0)
    return state, curve


def _read_curve(path: Path) -> tuple[CurvePoint, ...]:
    try:
        return tuple(CurvePoint(**point) for point in json.loads(path.read_text()))
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"{path}: missing or damaged training curve ({error}); train into a new folder") from error
