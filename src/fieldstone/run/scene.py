"""A scene: what is known of a place from photos of it, as one value.

`reconstruct` makes one from photos, `open_scene` from posed photos that this or another tool has left in a folder.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from fieldstone.records.mapping import ModelSummary, RunRecord
from fieldstone.report.figure_store import write_figures
from fieldstone.report.figures import PhotoByName, mapping_figures, shrunk, thumbnails
from fieldstone.report.page import Story
from fieldstone.run.folder import RunFolder
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Reconstruction


@dataclass(frozen=True, eq=False)
class Scene:
    """Photos that found their place, the points that they see, and the story of how they found it.

    Poses are `cam_from_world` in the units of the first model; pixels are those of the upright photos.
    """

    record: RunRecord
    """Every number of the run, and a verdict on every photo."""
    run: MappingRun
    """The models, the matched photos behind them, and what every stage did."""
    photo_of: PhotoByName
    """Decodes a photo by its name, no finer than figures need."""
    photos_folder: Path
    masks_folder: Path | None = None

    @property
    def model(self) -> Reconstruction:
        """The model with most photos."""
        return self.run.reconstruction

    @property
    def models(self) -> tuple[Reconstruction, ...]:
        """All models, the one with most photos first; they share no photo."""
        return (self.run.reconstruction, *self.run.others)

    @property
    def graph(self) -> MatchGraph:
        """The matched photos: keypoints, matches, and the geometry of every pair."""
        return self.run.graph

    @property
    def verdicts(self) -> Mapping[str, str]:
        """For every photo by name: in which model with how many points, or why in none."""
        return {photo.name: photo.verdict for photo in self.record.photos}

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions that a user should know of."""
        return self.record.notes

    @property
    def summary(self) -> ModelSummary:
        """The numbers of the model that one looks at first."""
        return self.record.summary

    def save(self, folder: str | Path, *, report: bool = True) -> None:
        """Write `sparse/0` and so on (COLMAP), `points.ply`, `run.json`, and the report with its figures.

        Args:
            report: Whether to draw figures and page.

        Raises:
            InputError: Another process writes to the folder, or it cannot be written.
        """
        out = RunFolder(Path(folder))
        with out.sole_writer():
            write_scene(self, out, report=report)


def write_scene(
    scene: Scene,
    out: RunFolder,
    *,
    report: bool = True,
    small: Mapping[str, UInt8[np.ndarray, "_ _ 3"]] | None = None,
) -> Scene:
    """Everything that a folder holds of a scene; whoever calls holds the folder.

    Args:
        small: Thumbnails of photos by name; None: they are made here.

    Returns:
        The scene with the record that was written: it knows the folders and how long writing took.
    """
    start = time.perf_counter()
    run = scene.run
    out.write_models(scene.models)
    out.write_covariance(run.uncertainty, run.graph.names)
    if report:
        photo_of = shrunk(scene.photo_of)
        small = thumbnails(run.graph.names, photo_of) if small is None else small
        write_figures(out.figures, "mapping", mapping_figures(run, photo_of), small)
    seconds = {**scene.record.seconds, "writing": round(time.perf_counter() - start, 3)}
    masks = scene.masks_folder
    record = replace(
        scene.record,
        seconds=seconds,
        photos_folder=out.relative(scene.photos_folder),
        masks_folder=None if masks is None else out.relative(masks),
    )
    out.write_run(record)
    if report:
        out.write_report(Story(record, out.read_metrics(), out.read_curve()))
    return replace(scene, record=record)


def summary_of(model: Reconstruction, num_photos: int) -> ModelSummary:
    """The numbers of a model that one looks at first."""
    errors = model.reprojection_errors()
    some = len(errors) > 0
    return ModelSummary(
        registered=len(model.registered()),
        photos=num_photos,
        points=len(model.points),
        observations=len(model.observations),
        mean_px=float(errors.mean()) if some else None,
        median_px=float(np.median(errors)) if some else None,
        rms_px=float(np.sqrt(np.mean(errors**2))) if some else None,
        mean_track_length=len(errors) / len(model.points) if some else None,
    )


def sizes_of(models: Sequence[Reconstruction]) -> tuple[int, ...]:
    """Registered photos of every model."""
    return tuple(len(model.registered()) for model in models)
