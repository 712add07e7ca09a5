"""A trained field as one value: it renders views, makes films, a mesh and splats, and goes to disk and back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, in_world
from fieldstone.field.base.training import NetworkOptions
from fieldstone.field.grid.field import GridField, field_from_tensors
from fieldstone.field.grid.render import renderer
from fieldstone.field.grid_training.plan import GridPlan, plan_from_json
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.progress import OnProgress, silent
from fieldstone.records.field import CurvePoint, FieldHeader, FieldMetrics
from fieldstone.rendering.views import RenderedView, render_view
from fieldstone.run.checkpointing import frame_of_record, state_of_tensors
from fieldstone.run.film import Film, film_of
from fieldstone.run.folder import RunFolder
from fieldstone.run.mesh import FieldMesh, mesh_of
from fieldstone.run.network_training import open_training
from fieldstone.run.options import RenderOptions, SurfaceOptions, workers
from fieldstone.run.splats import FieldSplats, splats_of
from fieldstone.scene.photos import PosedPhotos


@dataclass(frozen=True, eq=False)
class Field:
    """A radiance field, the photos that it was learned from, and how it was made. Poses and views are in the world."""

    header: FieldHeader
    """Kind, seed, photos and frame of the training."""
    tensors: Mapping[str, np.ndarray]
    """All arrays of the checkpoint."""
    curve: tuple[CurvePoint, ...] = ()
    """Every step of the training."""
    metrics: FieldMetrics | None = None
    """Of held-out views."""

    @property
    def kind(self) -> str:
        """fast, tiny or nerf."""
        return self.header.field

    @cached_property
    def frame(self) -> FieldFrame:
        """Where the field lives, and how far its rays reach."""
        return frame_of_record(self.header.frame)

    @cached_property
    def state(self) -> Mapping[str, np.ndarray]:
        """Arrays of the field itself."""
        return state_of_tensors(self.tensors)

    @cached_property
    def photos(self) -> PosedPhotos:
        """The training photos, without their files; at their refined poses, if they were refined."""
        poses = Rigid3(self.tensors["views.R"], self.tensors["views.t"])
        delta = self.state.get("moved")
        if delta is not None and delta.any():
            poses = poses.retract(delta)
        cameras = tuple(record.camera() for record in self.header.cameras)
        return PosedPhotos(self.header.names, cameras, np.array(self.header.camera_of_view, dtype=np.int64), poses)

    @cached_property
    def plan(self) -> GridPlan | None:
        """What the training followed; None for a network."""
        return plan_from_json(self.state["plan"].tobytes().decode()) if self.kind == "fast" else None

    @property
    def far(self) -> float:
        """Distance at which light that passes everything ends, in the world."""
        return self.frame.far / self.frame.normalized_from_world.scale

    def grid(self, purpose: str) -> GridField:
        """The field as grids.

        Args:
            purpose: What it is wanted for, as a message says.

        Raises:
            InputError: It is a network.
        """
        if self.kind != "fast":
            raise InputError(f"{purpose} needs the fast field, not the {self.kind} network; train the fast `field`")
        return self._grid

    @cached_property
    def _grid(self) -> GridField:
        return field_from_tensors(self.state)

    @contextmanager
    def renderer(self, *, device: str = "cpu", threads: int = 0) -> Iterator[RayRenderer]:
        """Colours, distances and opacities along rays in the world, with worker threads while the context lasts.

        Args:
            device: Of torch, for the networks; the grid field is rendered on the CPU.
            threads: 0: one for each core.

        Raises:
            InputError: torch or the device is missing, or the checkpoint lacks an array.
        """
        if self.kind == "fast":
            with ThreadPoolExecutor(workers(threads)) as executor:
                yield in_world(renderer(self._grid, self.frame, executor), self.frame)
            return
        options = NetworkOptions(**self.header.options)
        with open_training(
            options, self.frame, None, seed=self.header.seed, device=device, threads=workers(threads)
        ) as training:
            yield in_world(training.renderer(training.from_tensors(self.state)), self.frame)

    def render(self, camera: Camera, cam_from_world: Rigid3, *, device: str = "cpu", threads: int = 0) -> RenderedView:
        """One view: rgb (h, w, 3) in sRGB [0, 1], depth (h, w) along rays in units of the world, opacity (h, w).

        For many views, `renderer` and `rendering.views.render_view` start the threads once.
        """
        with self.renderer(device=device, threads=threads) as render_rays:
            return render_view(render_rays, camera, cam_from_world)

    def film(self, options: RenderOptions | None = None, **settings: Any) -> Film:
        """Views along a path, rendered as they are asked for; `save` writes them.

        Args:
            options: None: those that `settings` give.
            settings: Fields of `RenderOptions`.

        Raises:
            InputError: No such path.
        """
        chosen = options or RenderOptions(**settings)
        open_renderer = partial(self.renderer, device=chosen.device, threads=chosen.threads)
        return film_of(open_renderer, self.frame, self.photos, chosen)

    def mesh(
        self, options: SurfaceOptions | None = None, *, on_progress: OnProgress = silent, **settings: Any
    ) -> FieldMesh:
        """The surface as a coloured mesh without what floats about, and its agreement with the field.

        Args:
            options: None: those that `settings` give.
            settings: Fields of `SurfaceOptions`.

        Raises:
            InputError: Not the grid field, or nothing in it is solid.
        """
        chosen, grid = options or SurfaceOptions(**settings), self.grid("a mesh")
        with self.renderer(threads=chosen.threads) as render_rays:
            return mesh_of(grid, self.frame, self.photos, render_rays, chosen, on_progress)

    def splats(
        self, options: SurfaceOptions | None = None, *, on_progress: OnProgress = silent, **settings: Any
    ) -> FieldSplats:
        """The surface as Gaussian splats, and how much they look like the field.

        Args:
            options: None: those that `settings` give.
            settings: Fields of `SurfaceOptions`.

        Raises:
            InputError: Not the grid field, or nothing in it is solid.
        """
        chosen, grid = options or SurfaceOptions(**settings), self.grid("a file of splats")
        with self.renderer(threads=chosen.threads) as render_rays:
            return splats_of(grid, self.frame, self.photos, render_rays, chosen, on_progress)

    def save(self, folder: str | Path) -> None:
        """Write checkpoint, curve, plan and metrics to a folder that `open_field` opens.

        Raises:
            InputError: Another process writes there, or it cannot be written.
        """
        out = RunFolder(Path(folder))
        with out.sole_writer():
            out.write_curve(self.curve)
            if self.plan is not None:
                out.write_plan(self.plan.to_json() + "\n")
            if self.metrics is not None:
                out.write_metrics(self.metrics)
            out.write_checkpoint(self.header, self.tensors)


def open_field(folder: str | Path) -> Field:
    """The field that `train` or `Field.save` left in a folder.

    Raises:
        InputError: No checkpoint there, or a damaged one.
    """
    out = RunFolder(Path(folder))
    header, tensors = out.read_checkpoint()
    return Field(header, tensors, out.read_curve(), out.read_metrics())
