"""One self-contained HTML page: the story of a run, stage by stage, from its records and figures.

The page loads nothing, runs no script, and every name in it is escaped; its content security policy allows its own
style sheet, by hash, and images inside the file, and nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldstone.errors import InputError
from fieldstone.records.field import CurvePoint, FieldMetrics
from fieldstone.records.mapping import CameraRecord, ErrorRow, GradeWord, RunRecord, TruthErrors
from fieldstone.report.figure_store import FigureIndex, StoredFigure

SECTIONS = (
    ("matches", "Matches", "Which places of the photos look alike, and which of these pairs one geometry explains."),
    ("two-view", "Two views", "What the matches of two photos say of their relative pose."),
    ("triangulation", "Triangulation", "Points where the rays of matching pixels meet."),
    ("registration", "Further photos", "Each further photo finds its pose from the points that it sees."),
    ("bundle", "Bundle adjustment", "All poses and all points, refined together."),
    ("model", "Cameras and points", "The model that came out."),
    ("errors", "Errors", "Observed against reprojected pixels at every stage."),
    ("field", "Radiance field", "A field learned from the posed photos, and views of it that no camera took."),
)
"""Key, heading and introduction of the sections with figures, in the order of the page."""

GRADE_MEANING: dict[GradeWord, str] = {
    "good": "The matches of the photos, asked again without the model, agree with it.",
    "weak": "The model may be right, but little holds some of it.",
    "doubtful": "The matches of the photos contradict the model: do not rely on it.",
}
"""What a grade says, in a line."""

FIGURES_IN_SIGHT = 2
"""Photo figures of one kind beyond these are folded."""
MIME = {".svg": "image/svg+xml", ".jpg": "image/jpeg"}


@dataclass(frozen=True)
class Story:
    """What there is to tell of a run; what is missing leaves its part of the page out."""

    run: RunRecord | None = None
    metrics: FieldMetrics | None = None
    curve: Sequence[CurvePoint] = ()


@dataclass(frozen=True)
class _Fact:
    """A key number of the page's head."""

    value: str
    name: str
    note: str


@dataclass(frozen=True)
class _Photo:
    """The verdict on a photo, its error in the end, and its small picture."""

    name: str
    registered: bool
    verdict: str
    points: int
    mean_px: float | None
    thumbnail: str | None


@dataclass(frozen=True)
class _StageTotal:
    """The rows of all photos at one stage, pooled; no median, which does not pool."""

    stage: str
    photos: int
    points: int
    behind: int
    mean_px: float | None
    rms_px: float | None


@dataclass(frozen=True)
class _Section:
    key: str
    title: str
    text: str
    figures: Sequence[StoredFigure]
    folded: Sequence[StoredFigure]


def render_page(title: str, story: Story, index: FigureIndex, folder: Path) -> str:
    """The page as text.

    Args:
        folder: Where the images of the index lie.

    Raises:
        InputError: An image that the index names is missing, or a link out of the folder.
    """
    css = files("fieldstone.report").joinpath("templates/report.css").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(css.encode()).digest()).decode()
    environment = Environment(
        loader=PackageLoader("fieldstone.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=_number, seconds=_seconds, bar=_bar)
    run, metrics = story.run, story.metrics
    rows = () if run is None else run.table
    return environment.get_template("report.html.j2").render(
        title=title,
        css=css,
        style_hash=digest,
        run=run,
        metrics=metrics,
        facts=_facts(run, metrics),
        grade_meaning="" if run is None or run.grade is None else GRADE_MEANING[run.grade.word],
        photos=[] if run is None else _photos(run, index.thumbnails),
        sections=_sections(index),
        rows=rows,
        stages=_stage_totals(rows),
        largest_error=max((row.mean_px for row in rows if row.mean_px is not None), default=1.0),
        timings=_timings(run, metrics),
        truth={} if run is None or run.truth is None else asdict(run.truth),
        cameras=[] if run is None else [_camera(camera) for camera in run.cameras],
        data_uri=lambda name: _data_uri(folder, name),
    )


def _facts(run: RunRecord | None, metrics: FieldMetrics | None) -> list[_Fact]:
    """The numbers that a reader wants first; what is not known is left out."""
    facts = [] if run is None else _facts_of_model(run)
    if metrics is not None and metrics.psnr is not None:
        note = f"SSIM {_number(metrics.ssim, 3)}, {len(metrics.views)} held-out views"
        facts.append(_Fact(f"{_number(metrics.psnr, 2)} dB", "PSNR", note))
    timings = _timings(run, metrics)
    if timings:
        total = sum(seconds for _, seconds in timings)
        note = ", ".join(f"{name} {_seconds(s)}" for name, s in sorted(timings, key=lambda t: -t[1])[:2])
        facts.append(_Fact(_seconds(total), "in all", note))
    return facts


def _facts_of_model(run: RunRecord) -> list[_Fact]:
    summary = run.summary
    sizes = " + ".join(_number(n, 0) for n in run.components)
    several = len(run.components) > 1
    length = _number(summary.mean_track_length, 2)
    facts = [
        _Fact(
            f"{_number(summary.registered, 0)} of {_number(summary.photos, 0)}",
            "photos registered",
            (f"in {len(run.components)} models: {sizes}" if several else f"by the {run.mapper} mapper")
            + (", and an alternative" if run.alternative else ""),
        ),
        _Fact(_number(summary.points, 0), "points", f"each seen in {length} photos on average"),
        _Fact(
            f"{_number(summary.mean_px, 2)} px",
            "mean reprojection error",
            f"median {_number(summary.median_px, 2)}, {_number(summary.observations, 0)} observations",
        ),
    ]
    if run.truth is not None:
        facts.append(_fact_of_truth(run.truth))
    return facts


def _fact_of_truth(truth: TruthErrors) -> _Fact:
    return _Fact(f"{_number(truth.rotation_error_mean_deg, 3)}°", "mean rotation error", "against the known truth")


def _photos(run: RunRecord, thumbnails: Mapping[str, str]) -> list[_Photo]:
    """Verdict, points, final error and small picture of every photo."""
    final = {row.photo: row.mean_px for row in run.table if row.stage == "after BA"}
    return [
        _Photo(p.name, p.registered, p.verdict, p.points, final.get(p.name), thumbnails.get(p.name)) for p in run.photos
    ]


def _sections(index: FigureIndex) -> list[_Section]:
    """Sections that have figures, in the order of the page; figures of a section nobody knows go to the end."""
    known = {key for key, _, _ in SECTIONS}
    others = [f for f in index.figures if f.section not in known]
    out = []
    for key, title, text in (*SECTIONS, ("more", "More", "")):
        figures = others if key == "more" else [f for f in index.figures if f.section == key]
        alike: Counter[str] = Counter()
        folded = []
        for figure in figures:
            alike[figure.caption] += 1
            if figure.dark is None and alike[figure.caption] > FIGURES_IN_SIGHT:
                folded.append(figure)
        if figures:
            out.append(_Section(key, title, text, [f for f in figures if f not in folded], folded))
    return out


def _stage_totals(rows: Sequence[ErrorRow]) -> list[_StageTotal]:
    """Rows of all photos pooled by stage: sums of points, means weighted by them."""
    out = []
    for stage in dict.fromkeys(row.stage for row in rows):
        of_stage = [row for row in rows if row.stage == stage]
        seen = [(row.points, row.mean_px, row.rms_px) for row in of_stage if row.mean_px is not None]
        points = sum(n for n, _, _ in seen)
        mean = rms = None
        if points:
            mean = sum(n * mean_px for n, mean_px, _ in seen) / points
            rms = math.sqrt(sum(n * (rms_px or 0.0) ** 2 for n, _, rms_px in seen) / points)
        out.append(_StageTotal(stage, len(seen), points, sum(row.behind for row in of_stage), mean, rms))
    return out


def _camera(camera: CameraRecord) -> tuple[str, str, str, str]:
    """Model, size in pixels, parameters of a camera, and how certain they are."""
    size = f"{_number(camera.width, 0)} × {_number(camera.height, 0)}"
    certainty = "–" if camera.certainty is None else f"{camera.certainty}: {camera.reason}"
    return camera.model, size, camera.params_with_sds(), certainty


def _timings(run: RunRecord | None, metrics: FieldMetrics | None) -> list[tuple[str, float]]:
    """Seconds of every stage, in order."""
    timings = [] if run is None else [(_words(stage), seconds) for stage, seconds in run.seconds.items()]
    return timings if metrics is None else [*timings, ("training", metrics.seconds)]


def _data_uri(folder: Path, name: str) -> str:
    """An image of the folder as a data URI.

    Raises:
        InputError: It is missing, or a link out of the folder.
    """
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise InputError(f"{path}: the index of figures names it, but it is no file; remove the folder and run again")
    return f"data:{MIME[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _number(value: float | int | None, digits: int) -> str:
    """A number with separators of thousands; what is not known as a dash."""
    return "–" if value is None else f"{value:,.{digits}f}"


def _seconds(value: float) -> str:
    """Seconds as people say them."""
    if value < 60:
        return f"{value:.1f} s"
    minutes, seconds = divmod(round(value), 60)
    return f"{minutes} min {seconds:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _bar(value: float | None, largest: float) -> float:
    """Length of a bar between 0 and 100, on a square-root scale, so that small values stay visible."""
    if value is None or largest <= 0:
        return 0.0
    return round(100.0 * math.sqrt(min(max(value / largest, 0.0), 1.0)), 1)


def _words(key: str) -> str:
    return key.replace("_", " ")
