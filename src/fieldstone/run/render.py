"""A trained field to a film or to images along a camera path."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import quantize
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, in_world
from fieldstone.field.base.training import TrainOptions
from fieldstone.field.grid.field import field_from_tensors
from fieldstone.field.grid.render import renderer
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.checkpoint import read_checkpoint
from fieldstone.io.images.photos import write_photo
from fieldstone.io.images.video import write_gif, write_mp4
from fieldstone.io.posed.camera_path_json import read_camera_path
from fieldstone.render.camera_paths import orbit, spiral, through
from fieldstone.render.views import RenderedView, confidence_image, depth_image, normal_image, render_view
from fieldstone.run.fields import CHECKPOINT, frame_from_header, open_training, split_tensors

FilmFormat = Literal["mp4", "gif", "png"]
Shown = Literal["color", "depth", "normals", "opacity", "confidence"]

PATHS: dict[str, Callable[[Rigid3, int], Rigid3]] = {"orbit": orbit, "spiral": spiral, "through": through}

FRAMES = 120
"""Images of a path that is made up."""


def render_run(
    out: Path,
    *,
    path: str = "orbit",
    fmt: FilmFormat = "mp4",
    show: Shown = "color",
    frames: int | None = None,
    fps: int = 30,
    size_px: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Render a film of the field that `train_run` left in `out`.

    Args:
        path: orbit: around what the photos look at. spiral: loops about their mean. through: from photo to photo.
            dataset: the poses of the training photos. Else a JSON file with poses, see `io.camera_path_json`.
        fmt: mp4 and gif give one file, png a folder of numbered images.
        show: Colours, depth, normals, opacity or confidence.
        frames: Number of images; None: one for each pose of dataset and files, 120 for the other paths. Another number
            of a file's poses leads through them.
        size_px: Longer side of the images; None: as trained.
        on_frame: Called with the number of frames done and of all.

    Returns:
        The file or folder written: `out`/renders/PATH.mp4, .gif, or `out`/renders/PATH/, with the name of a file for
        PATH (orbit_json for an orbit.json); PATH_depth and so on for what is not colour.

    Raises:
        InputError: No usable checkpoint in `out`, or no such path.
    """
    if (frames is not None and frames < 1) or fps < 1 or (size_px is not None and size_px < 1):
        raise InputError(f"frames, fps and size must be at least 1, got {frames}, {fps}, {size_px}")
    tensors, header = read_checkpoint(out / CHECKPOINT)
    poses, state_tensors = split_tensors(tensors)
    frame = frame_from_header(header)
    camera = _camera(header["cameras"][0], size_px)
    name, poses_on_path = _poses_on(path, poses, frames)
    frames = len(poses_on_path.t)
    photos = _photos(header, poses)
    threads = threads or os.cpu_count() or 1
    with open_renderer(header, state_tensors, frame, device=device, threads=threads) as render_normalized:
        render_rays = in_world(render_normalized, frame)
        scale = frame.normalized_from_world.scale
        near, far = max(frame.near, 0.01 * frame.far) / scale, frame.far / scale

        def images() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
            for k in range(frames):
                view = render_view(render_rays, camera, poses_on_path[k])
                yield quantize(_shown(view, show, camera, poses_on_path[k], near, far, photos))
                on_frame(k + 1, frames)

        name = name if show == "color" else f"{name}_{show}"
        target = out / "renders" / (name if fmt == "png" else f"{name}.{fmt}")
        if fmt == "mp4":
            write_mp4(target, images(), fps=fps)
        elif fmt == "gif":
            write_gif(target, images(), fps=fps)
        else:
            for stale in target.glob("[0-9][0-9][0-9][0-9].png"):
                stale.unlink()
            for k, image in enumerate(images()):
                write_photo(target / f"{k:04d}.png", image)
    return target


def _poses_on(path: str, poses: Rigid3, frames: int | None) -> tuple[str, Rigid3]:
    """The name of a path for its file, and its poses."""
    if path in PATHS:
        return path, PATHS[path](poses, frames or FRAMES)
    if path != "dataset" and not path.lower().endswith(".json"):
        raise InputError(f"--path {path}: give one of {', '.join(PATHS)}, dataset, or a file PATH.json with poses")
    if path == "dataset":
        name, given = path, poses
    else:
        name, given = Path(path).stem, read_camera_path(Path(path))
        name = f"{name}_json" if name in (*PATHS, "dataset") else name
    return name, given if frames in (None, len(given.t)) else through(given, frames)


def _photos(header: Mapping[str, Any], poses: Rigid3) -> list[tuple[Camera, Rigid3]]:
    """Camera and pose of every training photo."""
    cameras = [_camera(stored, None) for stored in header["cameras"]]
    return [(cameras[c], poses[k]) for k, c in enumerate(header["camera_of_view"])]


def _shown(
    view: RenderedView,
    show: Shown,
    camera: Camera,
    cam_from_world: Rigid3,
    near: float,
    far: float,
    photos: Sequence[tuple[Camera, Rigid3]],
) -> Float[np.ndarray, "h w 3"]:
    if show == "depth":
        return depth_image(view, near, far).astype(np.float32)
    if show == "normals":
        return normal_image(view, camera).astype(np.float32)
    if show == "confidence":
        return confidence_image(view, camera, cam_from_world, photos, far).astype(np.float32)
    if show == "opacity":
        return np.repeat(view.opacity[:, :, None], 3, axis=2)
    return view.rgb


@contextmanager
def open_renderer(
    header: Mapping[str, Any], state_tensors: Mapping[str, np.ndarray], frame: FieldFrame, *, device: str, threads: int
) -> Iterator[RayRenderer]:
    """The renderer of the field in a checkpoint, in normalised coordinates, with its worker threads."""
    if header["field"] == "fast":
        with ThreadPoolExecutor(threads) as executor:
            yield renderer(field_from_tensors(state_tensors), frame, executor)
        return
    options = TrainOptions(**header["options"])
    with open_training(options, frame, None, seed=header["seed"], device=device, threads=threads) as training:
        yield training.renderer(training.from_tensors(state_tensors))


def _camera(stored: dict, size_px: int | None) -> Camera:
    camera = Camera(stored["model"], stored["width"], stored["height"], np.array(stored["params"]))
    if size_px is None:
        return camera
    factor = size_px / max(camera.width, camera.height)
    return rescale(camera, max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
