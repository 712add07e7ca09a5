"""Photos, or the course's match files, to camera poses, a point cloud and an honest error table."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fieldstone import __version__
from fieldstone.features.verification import verify_pairs
from fieldstone.io.course.matching_txt import is_course_folder
from fieldstone.io.files.atomic import write_json
from fieldstone.io.files.cache import Workspace
from fieldstone.io.files.checkpoint import write_checkpoint
from fieldstone.io.files.lock import sole_writer
from fieldstone.io.models.colmap import write_colmap
from fieldstone.io.shapes.ply import write_points
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.disambiguation.ambiguity import resolve_ambiguity
from fieldstone.mapping.incremental.checkpoint import GrowthMemory
from fieldstone.mapping.textbook import TextbookOptions, map_textbook
from fieldstone.report.figure_store import write_figures
from fieldstone.report.figures import mapping_figures, shrunk, thumbnails
from fieldstone.report.summary import write_report
from fieldstone.run.kept_growth import KeptGrowth
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photos_to_graph import Material, OnStage, match_photos, read_course
from fieldstone.scene.mapping_run import MappingRun, StageRecord
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Reconstruction, View

Mapper = Literal["auto", "textbook", "incremental", "global"]
UNITS = "units"
"""Folder below `work/` for what is kept."""

HOW_ERRORS_ARE_COUNTED = (
    "Every error is the distance in pixels between an observed keypoint and the reprojection of its point, taken over "
    "all observations that the stage used; a point behind its camera has no reprojection and is counted in its own "
    "column. Mean, median and RMS are over observations, not over points. 'PnP RANSAC' and 'non-linear PnP' count the "
    "inliers of the RANSAC, 'linear PnP' all correspondences. After bundle adjustment, observations over the "
    "threshold have been dropped: the table of drops says how many, where and why."
)


@dataclass(frozen=True)
class ReconstructOptions:
    """How a folder becomes a model."""

    mapper: Mapper = "auto"
    """auto: incremental for photos, and for given matches of places that look alike; textbook for other given matches.

    global places all photos at once.
    """
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    """Features, matches and two-view geometry of photos."""
    textbook: TextbookOptions = field(default_factory=TextbookOptions)
    incremental: AutomaticOptions = field(default_factory=AutomaticOptions)
    seed: int = 0
    """Every random number of the run follows from it."""
    fresh: bool = False
    """Use nothing that an earlier run has kept."""


def reconstruct(
    source: Path, out: Path, options: ReconstructOptions, *, on_stage: OnStage = lambda stage: None
) -> dict[str, Any]:
    """Reconstruct a folder of photos, or one in the course format, and write everything to `out`.

    Writes `sparse/0/` (COLMAP binary; further components in `sparse/1/` and so on), `points.ply`, `figures/`,
    `run.json` and `report.html`. Features, matches, two-view geometry and the growing model are kept in `work/` as they
    are found: a run that was stopped goes on from there when it is started again, and ends with the same bytes.

    Returns:
        What `run.json` holds.

    Raises:
        InputError: The folder is no usable input, or another process writes to `out`.
    """
    with sole_writer(out) as work:
        if options.fresh:
            shutil.rmtree(work / UNITS, ignore_errors=True)
        return _reconstruct(source, out, options, Workspace(work / UNITS), on_stage)


def _reconstruct(
    source: Path, out: Path, options: ReconstructOptions, workspace: Workspace, on_stage: OnStage
) -> dict[str, Any]:
    course = is_course_folder(source)
    if course:
        material = read_course(source)
    else:
        material = match_photos(source, options.matching, options.seed, on_stage, workspace)
    mapper = options.mapper if options.mapper != "auto" else "incremental"
    if course and options.mapper != "textbook":
        verified = replace(material, graph=_verified(material, options))
        if options.mapper == "auto" and not _look_alike(verified):
            mapper = "textbook"  # on the matches as given
        else:
            material = verified
    on_stage("mapping")
    start = time.perf_counter()
    memory = KeptGrowth(workspace)
    photo_of = shrunk(material.photo_of)
    with ThreadPoolExecutor(1) as meanwhile:
        small = meanwhile.submit(thumbnails, material.graph.names, photo_of)
        run = full_size(run_mapper(mapper, material, options, memory), material)
    seconds = {**material.seconds, "mapping": time.perf_counter() - start}
    on_stage("writing")
    start = time.perf_counter()
    write_models(run, out)
    write_covariance(run, out)
    write_figures(out / "figures", "mapping", mapping_figures(run, photo_of), small.result())
    seconds["writing"] = time.perf_counter() - start
    record = run_record(source, mapper, run, material, options.seed, seconds)
    # Relative, so that the two folders may move together.
    record["photos_folder"] = Path(os.path.relpath(source.resolve(), out.resolve())).as_posix()
    if options.matching.masks is not None:
        record["masks_folder"] = Path(os.path.relpath(options.matching.masks.resolve(), out.resolve())).as_posix()
    write_json(out / "run.json", record)
    write_report(out)
    memory.forget()
    return record


def write_models(run: MappingRun, out: Path) -> None:
    """`sparse/0`, `sparse/1`, ... and `points.ply`; the further models of an earlier run in this folder go."""
    models = [model for model in (run.reconstruction, *run.others) if len(model.registered())]
    for k, model in enumerate(models):
        write_colmap(model, out / "sparse" / str(k))
    for k in range(len(models), _components_of_earlier_run(out)):
        shutil.rmtree(out / "sparse" / str(k), ignore_errors=True)
    if len(run.reconstruction.points):
        write_points(run.reconstruction.points, out / "points.ply")
    elif (out / "run.json").exists():
        (out / "points.ply").unlink(missing_ok=True)


def write_covariance(run: MappingRun, out: Path) -> None:
    """`covariance.safetensors`, if it was asked for: `views` (n, 6, 6), `points` (p, 3, 3)."""
    path = out / "covariance.safetensors"
    if run.uncertainty is None:
        path.unlink(missing_ok=True)
        return
    facts = {"sigma_px": run.uncertainty.sigma_px, "photos": list(run.graph.names)}
    write_checkpoint(path, {"views": run.uncertainty.of_views, "points": run.uncertainty.of_points}, facts)


def _components_of_earlier_run(out: Path) -> int:
    """How many models the run that wrote `run.json` left; 0 without a readable one."""
    try:
        return len(json.loads((out / "run.json").read_text(encoding="utf-8"))["components"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def run_mapper(
    mapper: Mapper, material: Material, options: ReconstructOptions, memory: GrowthMemory | None = None
) -> MappingRun:
    """One of the mappers on the same material."""
    graph, cameras, camera_of_image = material.graph, material.cameras, material.camera_of_image
    if mapper == "textbook":
        textbook = replace(options.textbook, refine_focal=not material.known.all())
        return map_textbook(graph, cameras, camera_of_image, textbook, options.seed)
    automatic = replace(options.incremental.with_threads(options.matching.threads), mapper=mapper)
    return map_automatic(
        graph, cameras, camera_of_image, material.known, automatic, options.seed, material.second_look, memory
    )


def _look_alike(verified: Material) -> bool:
    """Whether pairs of different places match falsely: the textbook mapper knows of one place only."""
    resolution = resolve_ambiguity(verified.graph, verified.cameras, verified.camera_of_image)
    return bool(resolution.left_out.any())


def _verified(material: Material, options: ReconstructOptions) -> MatchGraph:
    """Given matches with the geometry of every pair."""
    matching, cameras, camera_of_image = options.matching, material.cameras, material.camera_of_image
    return verify_pairs(material.graph, cameras, camera_of_image, matching.two_view, options.seed, matching.threads)


def full_size(run: MappingRun, material: Material) -> MappingRun:
    """The run in the pixels of the photos: models, matches and records."""
    factor = material.pixel_factors()
    model = material.full_size(run.reconstruction)
    camera_of_image = np.array([view.camera for view in model.views], dtype=np.int64)
    scale = factor[camera_of_image]

    def scaled(record: StageRecord) -> StageRecord:
        by = scale[record.view]
        return replace(record, pixels=record.pixels * by, reprojected=record.reprojected * by)

    graph = replace(run.graph, keypoints=tuple(k * s for k, s in zip(run.graph.keypoints, scale, strict=True)))
    return replace(
        run,
        reconstruction=model,
        graph=graph,
        records=tuple(scaled(record) for record in run.records),
        before_bundle=None if run.before_bundle is None else material.full_size(run.before_bundle),
        others=tuple(material.full_size(other) for other in run.others),
    )


def run_record(
    source: Path, mapper: str, run: MappingRun, material: Material, seed: int, seconds: Mapping[str, float]
) -> dict[str, Any]:
    """What `run.json` tells of a run."""
    model = run.reconstruction
    counts = np.bincount(model.observations.view, minlength=len(model.views))
    photos = [
        {
            "name": view.name,
            "registered": view.cam_from_world is not None,
            "verdict": run.verdicts[view.name] + _sharpness(view, material),
            "points": int(counts[k]),
        }
        for k, view in enumerate(model.views)
    ]
    if run.uncertainty is not None:
        for k in model.registered():
            photos[k]["sd_rotation_deg"] = float(run.uncertainty.rotation_deg[k])
            photos[k]["sd_center"] = float(run.uncertainty.center[k])
    photos += [
        {
            # Not every file name is text.
            "name": p.path.name.encode(errors="backslashreplace").decode(),
            "registered": False,
            "verdict": f"{p.kind}: {p.reason}",
            "points": 0,
        }
        for p in material.problems
        if p.path.name not in run.verdicts
    ]
    return {
        "version": __version__,
        "input": source.resolve().name,
        "mapper": mapper,
        "seed": seed,
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "summary": summary(model, len(photos)),
        "components": [len(m.registered()) for m in (model, *run.others)],
        "cameras": [
            {"model": c.model, "width": c.width, "height": c.height, "params": c.params.tolist()} for c in model.cameras
        ],
        "notes": [*material.notes, *run.notes],
        "photos": photos,
        "table": [record.as_row() for record in run.records],
        "drops": [asdict(drop) for drop in run.drops],
        "how_errors_are_counted": HOW_ERRORS_ARE_COUNTED,
    }


def _sharpness(view: View, material: Material) -> str:
    """For a photo that was not registered: how sharp it is, compared with the others."""
    if view.cam_from_world is not None or view.name not in material.sharpness:
        return ""
    median = float(np.median(list(material.sharpness.values())))
    own = material.sharpness[view.name]
    return f"; {100 * own / median:.0f} % as sharp as the median photo" if median > 0.0 else "; no detail in any photo"


def summary(model: Reconstruction, num_photos: int) -> dict[str, Any]:
    """The numbers of a model that one looks at first."""
    errors = model.reprojection_errors()
    some = len(errors) > 0
    return {
        "registered": len(model.registered()),
        "photos": num_photos,
        "points": len(model.points),
        "observations": len(model.observations),
        "mean_px": float(errors.mean()) if some else None,
        "median_px": float(np.median(errors)) if some else None,
        "rms_px": float(np.sqrt(np.mean(errors**2))) if some else None,
        "mean_track_length": len(errors) / len(model.points) if some else None,
    }
