"""Which figures tell the story of a run, and what each of them shows.

`mapping_figures` and `field_figures` choose; the drawing is in `photo_figures`, `model_figures` and `chart_figures`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from jaxtyping import UInt8

from fieldstone.geometry.camera import Camera
from fieldstone.records.field import CurvePoint, ViewScores
from fieldstone.report import chart_figures, model_figures, photo_figures
from fieldstone.report.figure_store import ReportFigure
from fieldstone.report.raster import DRAWN_PX, small
from fieldstone.report.theme import evenly
from fieldstone.scene.mapping_run import MappingRun, StageRecord
from fieldstone.scene.match_graph import ImagePair, MatchGraph

PhotoByName = Callable[[str], UInt8[np.ndarray, "_ _ 3"] | None]
"""Gives the pixels of a photo, None if they are not at hand; called when a figure is drawn, so that few are held."""

KEPT_PHOTOS = 32
"""Small photos that are held in case another figure shows them too."""


@dataclass(frozen=True)
class FigureOptions:
    """How much to draw."""

    max_pairs: int = 3
    """Pairs whose matches and epipolar lines are drawn: the initial pair, then those with most matches."""
    max_photos: int = 5
    """Photos whose reprojections are drawn, for each comparison: those with the largest error at its first stage."""
    max_views: int = 4
    """Rendered views that are drawn beside the true ones: evenly from the worst to the best."""
    max_thumbnails: int = 60
    """Photos that get a small picture beside their verdict."""

    def __post_init__(self) -> None:
        if min(self.max_pairs, self.max_photos, self.max_views, self.max_thumbnails) < 0:
            raise ValueError(f"numbers of figures cannot be negative, got {self}")


REFINEMENTS = (
    (
        "triangulation",
        ("linear triangulation", "non-linear triangulation"),
        "Linear triangulation minimises an algebraic error, the refinement the distance in the photo: the vectors "
        "from what was observed (crosses) to where the new points reappear (dots) should get shorter.",
    ),
    (
        "registration",
        ("linear PnP", "PnP RANSAC", "non-linear PnP"),
        "Linear PnP takes every correspondence and one false one spoils it; RANSAC finds a pose that most agree "
        "with; the refinement fits it to those. The vectors should shrink from left to right.",
    ),
    (
        "bundle",
        ("before BA", "after BA"),
        "The same photo before and after the last round of bundle adjustment. What is left afterwards should point "
        "in all directions: vectors that agree over a region hint at a wrong camera or lens model.",
    ),
)


def mapping_figures(
    run: MappingRun, photo_of: PhotoByName, options: FigureOptions | None = None
) -> Iterator[ReportFigure]:
    """The figures of a reconstruction, in the order of its stages.

    What did not happen has no figure: no initial pair, no four poses; one registered photo, no overlay.
    """
    options = options or FigureOptions()
    model, graph = run.reconstruction, run.graph
    yield ReportFigure(
        "matches",
        "match-matrix",
        "Matches between photos",
        "Above the diagonal the matches as given, below it those that agree with one epipolar geometry. A photo whose "
        "row is empty cannot be placed.",
        lambda theme: chart_figures.match_matrix_figure(graph, theme=theme),
        layout="half",
    )
    if len(model.observations):
        yield ReportFigure(
            "matches",
            "track-lengths",
            "Track lengths",
            "In how many photos each point of the model is seen. Long tracks tie photos together; points seen twice "
            "have nothing that checks them.",
            lambda theme: chart_figures.track_lengths_figure(model.observations, theme=theme),
            layout="half",
        )
    yield from _pair_figures(run, photo_of, options)
    if run.before_bundle is not None and len(model.registered()) >= 2:
        before = run.before_bundle
        yield ReportFigure(
            "bundle",
            "bundle-overlay",
            "Cameras and points before and after bundle adjustment",
            "Both models in one frame, cameras as frusta. A model that was adjusted while it grew moves little here; "
            "large moves mean that errors had piled up.",
            lambda theme: model_figures.bundle_overlay_figure(before, model, theme=theme),
        )
    for section, stages, caption in REFINEMENTS:
        yield from _refinement_figures(run, photo_of, section, stages, caption, options.max_photos)
    if any(len(record.errors()) for record in run.records):
        yield ReportFigure(
            "errors",
            "error-histograms",
            "Reprojection errors of all photos",
            "In each panel the later stage should lie to the left of the earlier one. All observations of a stage "
            "count, also those that were dropped after it.",
            lambda theme: chart_figures.error_histograms_figure(run.records, theme=theme),
        )
    if len(model.registered()):
        yield from _model_figures(run)


def field_figures(
    curve: Sequence[CurvePoint],
    rendered: Callable[[str], UInt8[np.ndarray, "_ _ 3"]],
    true: Callable[[str], UInt8[np.ndarray, "_ _ 3"]],
    scores: Mapping[str, ViewScores],
    options: FigureOptions | None = None,
) -> Iterator[ReportFigure]:
    """The figures of a trained field: its curve, and rendered views beside the true ones, by name.

    Args:
        rendered, true: Pixels of a view by its label; asked for the views that are shown.
        scores: Of every rendered view, by its label; they choose which views are shown.
    """
    options = options or FigureOptions()
    if curve:
        yield ReportFigure(
            "field",
            "training-curve",
            "Training",
            "Loss on training rays and PSNR over time. A curve that is still rising at its end would gain from a "
            "longer budget.",
            lambda theme: chart_figures.training_figure(curve, theme=theme),
        )
    names = sorted(scores, key=lambda name: (scores[name].psnr, name))
    chosen = [names[k] for k in evenly(len(names), options.max_views).tolist()]
    if chosen:
        rows = [(name, true(name), rendered(name), _score(scores[name])) for name in chosen]
        share = "" if len(chosen) == len(names) else f", {len(chosen)} of {len(names)} from the worst to the best"
        yield ReportFigure(
            "field",
            "rendered-views",
            f"Rendered against true views{share}",
            "Views that training never saw. Differences should sit on edges and fine texture only; whole areas that "
            "differ mean wrong geometry or colour.",
            lambda theme: chart_figures.rendered_views_figure(rows, theme=theme),
            on_dark=True,
        )


def shrunk(photo_of: PhotoByName) -> PhotoByName:
    """Photos in the size in which figures show them; the last ones asked for are kept."""

    @lru_cache(maxsize=KEPT_PHOTOS)
    def shrunk_photo_of(name: str) -> np.ndarray | None:
        photo = photo_of(name)
        return None if photo is None else small(photo, DRAWN_PX)

    return shrunk_photo_of


def thumbnails(
    names: Sequence[str],
    photo_of: PhotoByName,
    options: FigureOptions | None = None,
    *,
    longest_px: int = 176,
) -> dict[str, UInt8[np.ndarray, "_ _ 3"]]:
    """Small pictures of the first photos, for the verdicts."""

    def thumbnail(name: str) -> UInt8[np.ndarray, "_ _ 3"] | None:
        photo = photo_of(name)
        return None if photo is None else small(photo, longest_px)

    chosen = names[: (options or FigureOptions()).max_thumbnails]
    pictures = ((name, thumbnail(name)) for name in chosen)
    return {name: picture for name, picture in pictures if picture is not None}


def pairs_to_show(graph: MatchGraph, initial: ImagePair | None, at_most: int) -> list[ImagePair]:
    """The initial pair, then verified pairs by their number of inliers."""
    verified = [p for p in sorted(graph.two_views) if graph.two_views[p].kind in ("calibrated", "uncalibrated")]
    verified.sort(key=lambda p: (p != initial, -int(graph.two_views[p].inliers.sum()), p))
    return verified[:at_most]


def _pair_figures(run: MappingRun, photo_of: PhotoByName, options: FigureOptions) -> Iterator[ReportFigure]:
    """Matches, epipolar lines and the four poses."""
    graph, model, start = run.graph, run.reconstruction, run.initial_pair
    pairs = pairs_to_show(graph, None if start is None else start.pair, options.max_pairs)

    def draw(figure, pair: ImagePair, theme):
        cameras = (model.camera_of(pair[0]), model.camera_of(pair[1]))
        photos = (photo_of(graph.names[pair[0]]), photo_of(graph.names[pair[1]]))
        return figure(graph, pair, cameras, photos, theme=theme)

    for i, j in pairs:
        names = f"{graph.names[i]} and {graph.names[j]}"
        is_start = start is not None and start.pair == (i, j)
        yield ReportFigure(
            "matches",
            f"matches-{i:04d}-{j:04d}",
            f"Matches of {names}" + (", the pair that the model starts from" if is_start else ""),
            "False matches cross the others or join unlike places. RANSAC should leave lines that move smoothly over "
            "the photo and reject the rest.",
            partial(draw, photo_figures.matches_figure, (i, j)),
            on_dark=True,
        )
    for i, j in pairs:
        yield ReportFigure(
            "two-view",
            f"epipolar-{i:04d}-{j:04d}",
            f"Epipolar lines of {graph.names[i]} and {graph.names[j]}",
            "The match of a point must lie on the line of its colour. All lines meet in the epipole, where the second "
            "photo would see the first camera.",
            partial(draw, photo_figures.epipolar_figure, (i, j)),
            on_dark=True,
        )
    if start is not None:
        first, second = (graph.names[k] for k in start.pair)
        yield ReportFigure(
            "two-view",
            "four-poses",
            f"Four poses of {second} relative to {first}, from above",
            "The essential matrix leaves four poses: the base line may point either way, and the second camera may be "
            "turned by 180 degrees about it. Only one puts the points in front of both cameras.",
            lambda theme: model_figures.four_poses_figure(start, (first, second), theme=theme),
        )


def _refinement_figures(
    run: MappingRun, photo_of: PhotoByName, section: str, stages: tuple[str, ...], caption: str, at_most: int
) -> Iterator[ReportFigure]:
    """Reprojections at the stages of one comparison, of the photos with the largest error at the first of them."""
    by_view: dict[int, dict[str, StageRecord]] = {}
    for record in run.records:
        if record.stage in stages:
            by_view.setdefault(record.view, {})[record.stage] = record  # a photo tried twice: the last time counts

    def worst(view: int) -> tuple[float, int]:
        errors = next(iter(by_view[view].values())).errors()
        return -float(np.median(errors)) if len(errors) else 0.0, view

    chosen = sorted(sorted(by_view, key=worst)[:at_most])

    def draw(records: list[StageRecord], camera: Camera, name: str, theme):
        return photo_figures.reprojections_figure(records, camera, photo_of(name), theme=theme)

    for view in chosen:
        records = [by_view[view][stage] for stage in stages if stage in by_view[view]]
        camera, name = run.reconstruction.camera_of(view), run.graph.names[view]
        yield ReportFigure(
            section,
            f"{section}-{view:04d}",
            f"Reprojections in {name}: {', '.join(r.stage for r in records)}",
            caption,
            partial(draw, records, camera, name),
            on_dark=True,
        )


def _model_figures(run: MappingRun) -> Iterator[ReportFigure]:
    model = run.reconstruction
    yield ReportFigure(
        "model",
        "from-above",
        "Cameras and points from above",
        "Walls should be thin lines and corners right angles; the outermost 4 % of the points on either side "
        "may lie outside the frame.",
        lambda theme: model_figures.from_above_figure(model, theme=theme),
        on_dark=True,
        layout="half",
    )
    yield ReportFigure(
        "model",
        "perspective",
        "Cameras and points in perspective",
        "Seen from behind and above the cameras. Points should form surfaces that the frusta look at.",
        lambda theme: model_figures.perspective_figure(model, theme=theme),
        on_dark=True,
        layout="half",
    )


def _score(scores: ViewScores) -> str:
    return f"{scores.psnr:.2f} dB, SSIM {scores.ssim:.3f}"
