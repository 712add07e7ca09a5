"""A scene: what is known of a place from photos of it, as one value.

`reconstruct` makes one from photos, `open_scene` opens posed photos that this or another tool has left in a folder.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from fieldstone.errors import InputError
from fieldstone.io.posed.open import open_posed_scene
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.records.mapping import CameraTrial, Grade, ModelSummary, RunRecord
from fieldstone.report.figure_store import write_figures
from fieldstone.report.figures import PhotoByName, mapping_figures, thumbnails
from fieldstone.report.page import Story
from fieldstone.run.folder import RunFolder
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.photos import PosedPhotos
from fieldstone.scene.reconstruction import Reconstruction

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Mapped:
    """How photos became a scene: what only `reconstruct` knows."""

    run: MappingRun
    """The models, the matched photos behind them, and what every stage did."""
    photo_of: PhotoByName
    """A photo by its name in the size of figures; the last ones asked for are kept."""
    photos_folder: Path


@dataclass(frozen=True, eq=False)
class Scene:
    """Photos that found their place, what is known of that place, and how they found it.

    Poses are `cam_from_world` in the units of the first model; pixels are those of the upright photos.
    """

    posed: PosedScene | None
    """The photos that are registered and on disk, with points: what a field learns from. None: there are none."""
    record: RunRecord | None
    """Every number of the reconstruction, and a verdict on every photo. None: another tool made it."""
    mapped: Mapped | None = None
    """The story of the reconstruction. None: the scene was opened, not made."""
    masks_folder: Path | None = None

    @property
    def photos(self) -> PosedPhotos:
        """The registered photos: names, cameras, poses, files.

        Raises:
            InputError: There are none.
        """
        return self.known_poses().photos

    def known_poses(self) -> PosedScene:
        """The photos that are registered and on disk, with what is known of the scene.

        Raises:
            InputError: There are none.
        """
        if self.posed is None:
            raise InputError("no photo of the scene is both registered and on disk: there is nothing to learn from")
        return self.posed

    @property
    def models(self) -> tuple[Reconstruction, ...]:
        """All models, the one with most photos first; they share no photo. Empty where only poses are known."""
        if self.mapped is not None:
            return (self.mapped.run.reconstruction, *self.mapped.run.others)
        return () if self.posed is None or self.posed.model is None else (self.posed.model,)

    @property
    def alternative(self) -> tuple[Reconstruction, ...]:
        """Other models of the same photos, where places look alike and the photos do not tell which are true."""
        return () if self.mapped is None else self.mapped.run.alternative

    @property
    def model(self) -> Reconstruction:
        """The model with most photos.

        Raises:
            InputError: Only poses are known.
        """
        if not self.models:
            raise InputError("the scene has poses and no reconstruction: there is no model in it")
        return self.models[0]

    @property
    def graph(self) -> MatchGraph | None:
        """The matched photos: keypoints, matches, and the geometry of every pair. None if the scene was opened."""
        return None if self.mapped is None else self.mapped.run.graph

    @property
    def verdicts(self) -> Mapping[str, str]:
        """For every photo by name: in which model with how many points, or why in none; empty if nobody says."""
        return {} if self.record is None else {photo.name: photo.verdict for photo in self.record.photos}

    @property
    def calibration(self) -> tuple[CameraTrial, ...]:
        """Camera models that were tried on the first model, and what held-out observations say of them."""
        return () if self.record is None else self.record.calibration

    @property
    def grade(self) -> Grade | None:
        """How far the first model can be believed, with reasons and advice. None if the scene was not made here."""
        return None if self.record is None else self.record.grade

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions that a user should know of."""
        return () if self.record is None else self.record.notes

    @property
    def summary(self) -> ModelSummary:
        """The numbers of the model that one looks at first."""
        if self.record is not None:
            return self.record.summary
        return summary_of(self.model, len(self.model.views))

    def save(self, folder: str | Path, *, report: bool = True) -> None:
        """Write `sparse/0` and so on (COLMAP; an alternative comes last), `points.ply`, `run.json`, and the report.

        Args:
            report: Whether to draw figures and page.

        Raises:
            InputError: The scene was not made by `reconstruct`, another process writes to the folder, or it cannot be
                written.
        """
        out = RunFolder(Path(folder))
        with out.sole_writer():
            write_scene(self, out, report=report)


def open_scene(source: str | Path, *, photos: str | Path | None = None) -> Scene:
    """Posed photos that this or another tool has left.

    Args:
        source: Folder that `reconstruct` wrote, COLMAP model with its images, Blender or LLFF folder, or
            transforms.json of nerfstudio or instant-ngp.
        photos: Folder with the photos of a reconstruction, if they are not where they were.

    Raises:
        InputError: No posed photos, a damaged file, or photos missing.
    """
    folder = RunFolder(Path(source))
    record = _own_record(folder)
    taken_from = folder.recorded(None if record is None else record.photos_folder)
    masks = folder.recorded(None if record is None else record.masks_folder)
    posed = open_posed_scene(folder.path, None if photos is None else Path(photos), taken_from=taken_from)
    return Scene(posed, record, masks_folder=masks if masks is not None and masks.is_dir() else None)


def _own_record(folder: RunFolder) -> RunRecord | None:
    """What `reconstruct` has written there; None if it has not: other tools may have files of that name."""
    try:
        return folder.read_run()
    except InputError:
        logger.debug("%s is not of a reconstruction", folder.record)
        return None


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

    Raises:
        InputError: The scene was not made by `reconstruct`.
    """
    if scene.mapped is None or scene.record is None:
        raise InputError("only a scene that was reconstructed here can be saved; this one was opened from files")
    start = time.perf_counter()
    run = scene.mapped.run
    out.write_models((*scene.models, *scene.alternative))
    out.write_covariance(run.uncertainty, run.graph.names)
    if report:
        photo_of = scene.mapped.photo_of
        small = thumbnails(run.graph.names, photo_of) if small is None else small
        write_figures(out.figures, "mapping", mapping_figures(run, photo_of), small)
    seconds = {**scene.record.seconds, "writing": round(time.perf_counter() - start, 3)}
    masks = scene.masks_folder
    record = replace(
        scene.record,
        seconds=seconds,
        photos_folder=out.relative(scene.mapped.photos_folder),
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
