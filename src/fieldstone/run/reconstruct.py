"""Photos, or given matches, to camera poses, a point cloud and an honest error table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone import __version__
from fieldstone.io.files.cache import UnitCache
from fieldstone.io.given_matches.matching_txt import is_given_matches_folder
from fieldstone.io.images.photos import photo_name
from fieldstone.io.posed.model_photos import photos_of_model
from fieldstone.mapping.grading.grade import grade_run
from fieldstone.progress import OnProgress, Progress, silent
from fieldstone.records.mapping import CameraRecord, DropRecord, Grade, PhotoVerdict, RunRecord
from fieldstone.report.figures import PhotoByName, shrunk, thumbnails
from fieldstone.run.folder import RunFolder
from fieldstone.run.map_photos import ChosenMapper, map_given_matches, map_photos, map_with_textbook
from fieldstone.run.mapper_checkpoint import MapperCheckpoints
from fieldstone.run.matching.photos_to_graph import MatchedPhotos, match_photos, read_matched_photos
from fieldstone.run.reconstruct_options import ReconstructOptions
from fieldstone.run.scene import Mapped, Scene, sizes_of, summary_of, write_scene
from fieldstone.scene.mapping_run import MappingRun
from fieldstone.scene.reconstruction import View

HOW_ERRORS_ARE_COUNTED = (
    "Every error is the distance in pixels between an observed keypoint and the reprojection of its point, taken over "
    "all observations that the stage used; a point behind its camera has no reprojection and is counted in its own "
    "column. Mean, median and RMS are over observations, not over points. 'PnP RANSAC' and 'non-linear PnP' count the "
    "inliers of the RANSAC, 'linear PnP' all correspondences. After bundle adjustment, observations over the "
    "threshold have been dropped: the table of drops says how many, where and why."
)


def reconstruct(
    source: str | Path,
    options: ReconstructOptions | None = None,
    *,
    keep_in: str | Path | None = None,
    report: bool = True,
    on_progress: OnProgress = silent,
    **settings: Any,
) -> Scene:
    """Camera poses and a point cloud from a folder of photos, or from a data set with given matches.

    Args:
        source: Folder with photos; or with `calibration.txt`, `matching*.txt` and the photos.
        options: None: those that `settings` give.
        keep_in: Folder for the result: `sparse/0` (COLMAP; further models in `sparse/1` and so on), `points.ply`,
            `run.json`, `report.html`. Features, matches, two-view geometry and the state of the mapper are kept in its
            `work` as they are found: a run that was stopped goes on from there when it is started again, and ends with
            the same bytes. None: nothing is written.
        report: Whether to draw figures and page.
        on_progress: Hears how far every stage is.
        settings: Fields of `ReconstructOptions`, where no options are given.

    Returns:
        The scene; without a model (`scene.summary.registered` is 0) if no photo could be registered.

    Raises:
        InputError: The folder is no usable input, an option cannot be used, or another process writes to `keep_in`.
    """
    options = options or ReconstructOptions(**settings)
    if keep_in is None:
        return reconstructed(Path(source), options, UnitCache(), on_progress)
    out = RunFolder(Path(keep_in))
    with out.sole_writer(fresh=options.fresh) as cache:
        return reconstruct_into(out, cache, Path(source), options, report=report, on_progress=on_progress)


def reconstruct_into(
    out: RunFolder,
    cache: UnitCache,
    source: Path,
    options: ReconstructOptions,
    *,
    report: bool = True,
    on_progress: OnProgress = silent,
) -> Scene:
    """`reconstruct` for who holds the folder already."""
    with ThreadPoolExecutor(1) as meanwhile:
        small: list[Future[Mapping[str, np.ndarray]]] = []

        def draw_thumbnails(names: Sequence[str], photo_of: PhotoByName) -> None:
            if report:
                small.append(meanwhile.submit(thumbnails, names, photo_of))

        scene = reconstructed(source, options, cache, on_progress, draw_thumbnails)
    on_progress(Progress("writing"))
    scene = write_scene(scene, out, report=report, small=small[0].result() if small else None)
    MapperCheckpoints(cache).forget()
    return scene


def reconstructed(
    source: Path,
    options: ReconstructOptions,
    cache: UnitCache,
    on_progress: OnProgress,
    on_matched: Callable[[Sequence[str], PhotoByName], None] = lambda names, photo_of: None,
) -> Scene:
    """`reconstruct` without a folder: the stages, one after the other.

    Args:
        cache: Keeps what the stages find, and has what earlier runs have found.
        on_matched: Is called with the names of the matched photos, and what decodes them, before they are mapped.
    """
    given = is_given_matches_folder(source)
    photos = (
        read_matched_photos(source)
        if given
        else match_photos(source, options.matching(), options.seed, cache, on_progress)
    )
    photo_of = shrunk(photos.photo_of)
    on_matched(photos.graph.names, photo_of)
    start = time.perf_counter()
    mapper, run = run_mapper(photos, options, MapperCheckpoints(cache), on_progress, given=given)
    mapped = time.perf_counter()
    on_progress(Progress("grading"))
    grade = graded(run, photos, options)
    seconds = {**photos.seconds, "mapping": mapped - start, "grading": time.perf_counter() - mapped}
    record = run_record(source, mapper, run, photos, grade, options.seed, seconds)
    posed = photos_of_model(run.reconstruction, source)
    return Scene(posed, record, Mapped(run, photo_of, source), options.masks)


def run_mapper(
    photos: MatchedPhotos,
    options: ReconstructOptions,
    checkpoints: MapperCheckpoints,
    on_progress: OnProgress,
    *,
    given: bool,
) -> tuple[ChosenMapper, MappingRun]:
    """The mapper that was asked for, or that suits the matches, and its run.

    Args:
        given: The matches were given, without the geometry of pairs.
    """
    textbook, seed = options.tuning.textbook, options.seed
    mapping = options.mapping("global" if options.mapper == "global" else "incremental")
    if given:
        return map_given_matches(
            photos, options.mapper, options.matching(), mapping, textbook, seed, checkpoints, on_progress
        )
    if options.mapper == "textbook":
        return "textbook", map_with_textbook(photos, textbook, seed, on_progress)
    return mapping.mapper, map_photos(photos, options.matching(), mapping, seed, checkpoints, on_progress)


def graded(run: MappingRun, photos: MatchedPhotos, options: ReconstructOptions) -> Grade:
    """How far the first model can be believed, asked of the matches again."""
    known = photos.known[: len(run.reconstruction.cameras)]
    return grade_run(run, photos.graph, known, options.tuning.grading, options.seed, options.matching().threads)


def run_record(
    source: Path,
    mapper: str,
    run: MappingRun,
    photos: MatchedPhotos,
    grade: Grade,
    seed: int,
    seconds: Mapping[str, float],
) -> RunRecord:
    """What `run.json` tells of a run."""
    model = run.reconstruction
    verdicts = (*_verdicts_on_views(run, photos), *_verdicts_on_problems(run, photos, source))
    return RunRecord(
        version=__version__,
        input=source.resolve().name,
        mapper=mapper,
        seed=seed,
        seconds={stage: round(value, 3) for stage, value in seconds.items()},
        summary=summary_of(model, len(verdicts)),
        components=sizes_of((model, *run.others)),
        alternative=sizes_of(run.alternative),
        cameras=tuple(
            CameraRecord.of(camera, certainty) for camera, certainty in zip_longest(model.cameras, run.certainties)
        ),
        notes=(*photos.notes, *run.notes),
        photos=verdicts,
        table=tuple(record.row() for record in run.records),
        drops=tuple(DropRecord(drop.stage, drop.reason, drop.observations) for drop in run.drops),
        how_errors_are_counted=HOW_ERRORS_ARE_COUNTED,
        calibration=run.calibration,
        grade=grade,
    )


def _verdicts_on_views(run: MappingRun, photos: MatchedPhotos) -> Iterator[PhotoVerdict]:
    """Of every photo that was matched."""
    model, uncertainty = run.reconstruction, run.uncertainty
    counts = np.bincount(model.observations.view, minlength=len(model.views))
    for k, view in enumerate(model.views):
        registered = view.cam_from_world is not None
        determined = uncertainty if registered else None
        yield PhotoVerdict(
            name=view.name,
            registered=registered,
            verdict=run.verdicts[view.name] + _sharpness(view, photos),
            points=int(counts[k]),
            sd_rotation_deg=None if determined is None else float(determined.rotation_deg[k]),
            sd_center=None if determined is None else float(determined.center[k]),
        )


def _verdicts_on_problems(run: MappingRun, photos: MatchedPhotos, source: Path) -> Iterator[PhotoVerdict]:
    """Of every file that is no photo to work with."""
    for problem in photos.problems:
        name = photo_name(problem.path, source)
        if name not in run.verdicts:
            name = name.encode(errors="backslashreplace").decode()  # not every file name is text
            yield PhotoVerdict(name, registered=False, verdict=f"{problem.kind}: {problem.reason}", points=0)


def _sharpness(view: View, photos: MatchedPhotos) -> str:
    """For a photo that was not registered: how sharp it is, compared with the others."""
    if view.cam_from_world is not None or view.name not in photos.sharpness:
        return ""
    median = float(np.median(list(photos.sharpness.values())))
    own = photos.sharpness[view.name]
    return f"; {100 * own / median:.0f} % as sharp as the median photo" if median > 0.0 else "; no detail in any photo"
