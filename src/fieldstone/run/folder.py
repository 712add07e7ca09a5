"""The folder of a run: every file name in it, its lock, its records.

Stages hand values to each other; this is where values meet the disk. Nobody else knows what a file is called.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_json, write_text
from fieldstone.io.files.cache import UnitCache
from fieldstone.io.files.checkpoint import read_checkpoint, write_checkpoint
from fieldstone.io.files.lock import sole_writer
from fieldstone.io.models.colmap import write_colmap
from fieldstone.io.shapes.ply import write_points
from fieldstone.records.field import CurvePoint, FieldHeader, FieldMetrics
from fieldstone.records.files import from_json, read_record, read_records, to_json
from fieldstone.records.mapping import RunRecord
from fieldstone.records.shapes import MeshRecord, SplatRecord
from fieldstone.report.figure_store import read_index
from fieldstone.report.page import Story, render_page
from fieldstone.scene.mapping_run import Uncertainty
from fieldstone.scene.reconstruction import Reconstruction

UNITS = "units"
"""Folder below `work/` for what is kept between runs."""


@dataclass(frozen=True)
class RunFolder:
    """Where a run keeps and leaves what it makes."""

    path: Path

    @property
    def record(self) -> Path:
        """Of the reconstruction."""
        return self.path / "run.json"

    @property
    def report(self) -> Path:
        """The page."""
        return self.path / "report.html"

    @property
    def figures(self) -> Path:
        """Images of the report, see `report.figure_store`."""
        return self.path / "figures"

    @property
    def points(self) -> Path:
        """The point cloud."""
        return self.path / "points.ply"

    @property
    def photos(self) -> Path:
        """Photos that a run makes itself."""
        return self.path / "photos"

    @property
    def covariance(self) -> Path:
        """Covariances of poses and points."""
        return self.path / "covariance.safetensors"

    @property
    def checkpoint(self) -> Path:
        """All that rendering and going on with the training need."""
        return self.path / "checkpoint.safetensors"

    @property
    def curve(self) -> Path:
        """Every step of the training."""
        return self.path / "curve.json"

    @property
    def plan(self) -> Path:
        """What the training of a grid field follows."""
        return self.path / "plan.json"

    @property
    def metrics(self) -> Path:
        """How alike held-out views and their photos are."""
        return self.path / "metrics.json"

    @property
    def preview(self) -> Path:
        """The first training view as the field shows it now."""
        return self.path / "preview.png"

    @property
    def held_out_views(self) -> Path:
        """Folder of the rendered views that were measured."""
        return self.path / "renders" / "test"

    @property
    def splats(self) -> Path:
        """Gaussian splats."""
        return self.path / "splats.ply"

    @property
    def splat_record(self) -> Path:
        """What is said of them."""
        return self.path / "splats.json"

    @property
    def mesh_record(self) -> Path:
        """What is said of the mesh."""
        return self.path / "mesh.json"

    def model(self, index: int) -> Path:
        """Folder of a model in COLMAP's format; 0 is the largest."""
        return self.path / "sparse" / str(index)

    def film(self, name: str, suffix: str) -> Path:
        """A film, or without a suffix a folder of images."""
        return self.path / "renders" / f"{name}{suffix}"

    def mesh(self, suffix: str) -> Path:
        """The mesh in one of its formats."""
        return self.path / f"mesh{suffix}"

    @contextmanager
    def sole_writer(self, *, fresh: bool = False) -> Iterator[UnitCache]:
        """Hold the folder for this process; every verb that writes does so first.

        Args:
            fresh: Forget what earlier runs have kept.

        Yields:
            What runs keep of their finished units.

        Raises:
            InputError: Another process writes there, or it cannot be written.
        """
        with sole_writer(self.path) as work:
            if fresh:
                shutil.rmtree(work / UNITS, ignore_errors=True)
            yield UnitCache(work / UNITS)

    def relative(self, path: Path) -> str:
        """A path as seen from this folder, so that both may move together."""
        return Path(os.path.relpath(path.resolve(), self.path.resolve())).as_posix()

    def recorded(self, relative: str | None) -> Path | None:
        """The path that `relative` made a text of; None for None."""
        return None if relative is None else (self.path / relative).resolve()

    def write_models(self, models: Sequence[Reconstruction]) -> None:
        """`sparse/0`, `sparse/1`, ... and the points of the first; further models of an earlier run go.

        Models without a registered photo are left out.
        """
        models = [model for model in models if len(model.registered())]
        for k, model in enumerate(models):
            write_colmap(model, self.model(k))
        for k in range(len(models), self._models_of_earlier_run()):
            shutil.rmtree(self.model(k), ignore_errors=True)
        if models and len(models[0].points):
            write_points(models[0].points, self.points)
        elif self.record.exists():
            self.points.unlink(missing_ok=True)

    def _models_of_earlier_run(self) -> int:
        """How many models the run that wrote `run.json` left; 0 without a readable one."""
        try:
            record = self.read_run()
        except InputError:
            return 0
        return 0 if record is None else len(record.components) + len(record.alternative)

    def write_covariance(self, uncertainty: Uncertainty | None, names: Sequence[str]) -> None:
        """`views` (n, 6, 6) and `points` (p, 3, 3); None: those of an earlier run go."""
        if uncertainty is None:
            self.covariance.unlink(missing_ok=True)
            return
        facts = {"sigma_px": uncertainty.sigma_px, "photos": list(names)}
        arrays = {"views": uncertainty.of_views, "points": uncertainty.of_points}
        write_checkpoint(self.covariance, arrays, facts)

    def write_run(self, record: RunRecord) -> None:
        """`run.json`."""
        write_json(self.record, to_json(record))

    def read_run(self) -> RunRecord | None:
        """What `run.json` says; None if there is none.

        Raises:
            InputError: It is damaged.
        """
        return read_record(RunRecord, self.record) if self.record.is_file() else None

    def write_checkpoint(self, header: FieldHeader, tensors: Mapping[str, np.ndarray]) -> None:
        """Arrays and header of a field, whole or not at all."""
        write_checkpoint(self.checkpoint, tensors, to_json(header))

    def read_checkpoint(self) -> tuple[FieldHeader, dict[str, np.ndarray]]:
        """Header and arrays of a field.

        Raises:
            InputError: No checkpoint, or a damaged one.
        """
        tensors, header = read_checkpoint(self.checkpoint)
        return from_json(FieldHeader, header, str(self.checkpoint)), tensors

    def write_curve(self, curve: Sequence[CurvePoint]) -> None:
        """`curve.json`."""
        write_json(self.curve, [to_json(point) for point in curve])

    def read_curve(self) -> tuple[CurvePoint, ...]:
        """The training curve; empty if there is none.

        Raises:
            InputError: It is damaged.
        """
        return read_records(CurvePoint, self.curve) if self.curve.is_file() else ()

    def write_plan(self, text: str) -> None:
        """`plan.json`."""
        write_text(self.plan, text)

    def write_metrics(self, metrics: FieldMetrics) -> None:
        """`metrics.json`."""
        write_json(self.metrics, to_json(metrics))

    def read_metrics(self) -> FieldMetrics | None:
        """What `metrics.json` says; None if there is none.

        Raises:
            InputError: It is damaged.
        """
        return read_record(FieldMetrics, self.metrics) if self.metrics.is_file() else None

    def write_mesh_record(self, record: MeshRecord) -> None:
        """`mesh.json`."""
        write_json(self.mesh_record, to_json(record))

    def write_splat_record(self, record: SplatRecord) -> None:
        """`splats.json`."""
        write_json(self.splat_record, to_json(record))

    def read_story(self) -> Story:
        """What earlier verbs have written here.

        Raises:
            InputError: The folder does not exist, or one of its records is damaged.
        """
        if not self.path.is_dir():
            raise InputError(f"{self.path}: no such folder; give the folder that a run wrote")
        return Story(self.read_run(), self.read_metrics(), self.read_curve())

    def write_report(self, story: Story) -> None:
        """The page of a run, whole or not at all, with the figures that lie in the folder."""
        title = Path((story.run.input if story.run else "") or self.path.resolve()).name or "fieldstone"
        write_text(self.report, render_page(title, story, read_index(self.figures), self.figures))
