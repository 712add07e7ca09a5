"""Films: views of a field along a camera path."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import quantize
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import write_photo
from fieldstone.io.images.video import write_gif, write_mp4
from fieldstone.io.posed.camera_path_json import read_camera_path
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.rendering.camera_paths import orbit, spiral, through
from fieldstone.rendering.views import RenderedView, confidence_image, depth_image, normal_image, render_view
from fieldstone.run.options import RenderOptions, Shown
from fieldstone.scene.photos import PosedPhotos

PATHS: dict[str, Callable[[Rigid3, int], Rigid3]] = {"orbit": orbit, "spiral": spiral, "through": through}

FRAMES = 120
"""Images of a path that is made up."""


@dataclass(frozen=True, eq=False)
class Film:
    """Views of a field along a path, rendered as they are asked for."""

    open_renderer: Callable[[], AbstractContextManager[RayRenderer]]
    """The field, in the world, with its threads."""
    frame: FieldFrame
    photos: PosedPhotos
    """Those that the field was learned from."""
    name: str
    """Of the path and of what is shown: orbit, walk_depth."""
    camera: Camera
    cam_from_world: Rigid3
    """A pose for each image."""
    options: RenderOptions

    def __len__(self) -> int:
        return len(self.cam_from_world.t)

    def images(self, on_progress: OnProgress = silent) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """The images, one after the other."""
        stage, options = StageProgress(on_progress, "rendering", len(self)), self.options
        with self.open_renderer() as render_rays:
            for k in range(len(self)):
                pose = self.cam_from_world[k]
                view = render_view(render_rays, self.camera, pose)
                yield quantize(_shown(view, options.show, self, pose))
                stage.advance()

    def save(self, path: str | Path, on_progress: OnProgress = silent) -> Path:
        """Write a film (.mp4, .gif), or a folder of numbered images where the path has no suffix.

        Raises:
            InputError: Another suffix, or a path that cannot be written.
        """
        target = Path(path)
        if target.suffix == ".mp4":
            write_mp4(target, self.images(on_progress), fps=self.options.fps)
        elif target.suffix == ".gif":
            write_gif(target, self.images(on_progress), fps=self.options.fps)
        elif not target.suffix:
            for stale in target.glob("[0-9][0-9][0-9][0-9].png"):
                stale.unlink()
            for k, image in enumerate(self.images(on_progress)):
                write_photo(target / f"{k:04d}.png", image)
        else:
            raise InputError(f"{target}: films are .mp4 or .gif, or a folder of images without a suffix")
        return target


def film_of(
    open_renderer: Callable[[], AbstractContextManager[RayRenderer]],
    frame: FieldFrame,
    photos: PosedPhotos,
    options: RenderOptions,
) -> Film:
    """The film that the options describe, not yet rendered.

    Raises:
        InputError: No such path.
    """
    name, poses = _poses_on(options.path, photos.cam_from_world, options.frames)
    name = name if options.show == "color" else f"{name}_{options.show}"
    return Film(open_renderer, frame, photos, name, _of_size(photos.cameras[0], options.size), poses, options)


def _poses_on(path: str, poses: Rigid3, frames: int | None) -> tuple[str, Rigid3]:
    """The name of a path for its file, and its poses."""
    if path in PATHS:
        return path, PATHS[path](poses, frames or FRAMES)
    if path != "dataset" and not path.lower().endswith(".json"):
        raise InputError(f"`path` {path}: give one of {', '.join(PATHS)}, dataset, or a file PATH.json with poses")
    if path == "dataset":
        name, given = path, poses
    else:
        name, given = Path(path).stem, read_camera_path(Path(path))
        name = f"{name}_json" if name in (*PATHS, "dataset") else name
    return name, given if frames in (None, len(given.t)) else through(given, frames)


def _shown(view: RenderedView, show: Shown, film: Film, cam_from_world: Rigid3) -> Float[np.ndarray, "h w 3"]:
    """What an image of the film shows of a view."""
    frame, photos, scale = film.frame, film.photos, film.frame.normalized_from_world.scale
    if show == "depth":
        near = max(frame.near, 0.01 * frame.far)
        return depth_image(view, near / scale, frame.far / scale).astype(np.float32)
    if show == "normals":
        return normal_image(view, film.camera).astype(np.float32)
    if show == "confidence":
        seen_from = [(photos.camera_of(v), photos.pose_of(v)) for v in range(len(photos))]
        return confidence_image(view, film.camera, cam_from_world, seen_from, frame.far / scale).astype(np.float32)
    if show == "opacity":
        return np.repeat(view.opacity[:, :, None], 3, axis=2)
    return view.rgb


def _of_size(camera: Camera, size_px: int | None) -> Camera:
    """The camera with a longer side of so many pixels; None: as it is."""
    if size_px is None:
        return camera
    factor = size_px / max(camera.width, camera.height)
    return rescale(camera, max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
