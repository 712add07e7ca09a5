"""One self-contained HTML page: the story of a run, stage by stage.

The page is rebuilt from what lies in the output folder (`run.json`, `metrics.json`, `curve.json`, `figures/`), whatever
of it there is. It loads nothing, runs no script, and every name in it is escaped; its content security policy allows
its own style sheet, by hash, and images inside the file, and nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_text
from fieldstone.report.figure_store import FigureIndex, StoredFigure, read_index, read_json

logger = logging.getLogger(__name__)

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

FIGURES_IN_SIGHT = 2
"""Photo figures of one kind beyond these are folded."""
MIME = {".svg": "image/svg+xml", ".jpg": "image/jpeg"}


@dataclass(frozen=True)
class _Fact:
    """A key number of the page's head."""

    value: str
    name: str
    note: str


@dataclass(frozen=True)
class _Section:
    key: str
    title: str
    text: str
    figures: Sequence[StoredFigure]
    folded: Sequence[StoredFigure]


def write_report(out: Path, *, title: str | None = None) -> Path:
    """Write `OUT/report.html` from what lies in the folder, whole or not at all.

    Missing files leave their part of the page out; missing or odd values show as a dash.

    Raises:
        InputError: The folder does not exist, or a file in it is not what a run wrote.
    """
    if not out.is_dir():
        raise InputError(f"{out}: no such folder; give the folder that a run wrote")
    run, metrics, curve = (_object(out / name, kind) for name, kind in _PARTS)
    index = read_index(out / "figures")
    name = title or Path(str(run.get("input") or out.resolve())).name or "fieldstone"
    page = render_page(name, run, metrics, curve, index, out / "figures")
    path = out / "report.html"
    write_text(path, page)
    logger.info("wrote %s: %d figures, %.1f MB", path, len(index.figures), len(page.encode()) / 1e6)
    return path


def render_page(
    title: str,
    run: Mapping[str, Any],
    metrics: Mapping[str, Any],
    curve: Sequence[Any],
    index: FigureIndex,
    folder: Path,
) -> str:
    """The page as text.

    Args:
        folder: Where the images of the index lie.
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
    rows = _rows(run.get("table"))
    return environment.get_template("report.html.j2").render(
        title=title,
        css=css,
        style_hash=digest,
        run=run,
        metrics=metrics,
        facts=_facts(run, metrics, curve),
        photos=_photos(run, rows, index.thumbnails),
        sections=_sections(index),
        rows=rows,
        stages=_stage_totals(rows),
        largest_error=max((r["mean_px"] for r in rows if _is_number(r["mean_px"])), default=1.0),
        drops=_rows(run.get("drops")),
        timings=_timings(run, metrics),
        views=_views(metrics),
        truth=_object_of(run.get("truth")),
        notes=[str(note) for note in _list_of(run.get("notes"))],
        cameras=[_camera(camera) for camera in _list_of(run.get("cameras")) if isinstance(camera, dict)],
        data_uri=lambda name: _data_uri(folder, name),
    )


_PARTS = (("run.json", dict), ("metrics.json", dict), ("curve.json", list))


def _object(path: Path, kind: type) -> Any:
    """What a JSON file holds; empty if there is no file.

    Raises:
        InputError: It holds something else than an object, or a list.
    """
    if not path.is_file():
        return kind()
    content = read_json(path)
    if not isinstance(content, kind):
        raise InputError(f"{path}: expected {'an object' if kind is dict else 'a list'}; run the command again")
    return content


def _facts(run: Mapping[str, Any], metrics: Mapping[str, Any], curve: Sequence[Any]) -> list[_Fact]:
    """The numbers that a reader wants first; what is not known is left out."""
    summary, facts = _object_of(run.get("summary")), []
    if "registered" in summary:
        share = f"{_number(summary['registered'], 0)} of {_number(summary.get('photos'), 0)}"
        parts = [n for n in _list_of(run.get("components")) if _is_number(n)]
        sizes = " + ".join(_number(n, 0) for n in parts)
        note = f"in {len(parts)} models: {sizes}" if len(parts) > 1 else f"by the {run.get('mapper', 'unknown')} mapper"
        facts.append(_Fact(share, "photos registered", note))
    if "points" in summary:
        length = _number(summary.get("mean_track_length"), 2)
        facts.append(_Fact(_number(summary["points"], 0), "points", f"each seen in {length} photos on average"))
    if "mean_px" in summary:
        note = f"median {_number(summary.get('median_px'), 2)}, {_number(summary.get('observations'), 0)} observations"
        facts.append(_Fact(f"{_number(summary['mean_px'], 2)} px", "mean reprojection error", note))
    for key, value in _object_of(run.get("truth")).items():
        if "deg" in key and _is_number(value):
            facts.append(_Fact(f"{_number(value, 3)}°", _words(key.replace("_deg", "")), "against the known truth"))
            break
    if "psnr" in metrics:
        views = len(_views(metrics))
        note = f"SSIM {_number(metrics.get('ssim'), 3)}" + (f", {views} held-out views" if views else "")
        facts.append(_Fact(f"{_number(metrics['psnr'], 2)} dB", "PSNR", note))
    timings = _timings(run, metrics)
    if timings:
        total = sum(seconds for _, seconds in timings)
        note = ", ".join(f"{name} {_seconds(s)}" for name, s in sorted(timings, key=lambda t: -t[1])[:2])
        facts.append(_Fact(_seconds(total), "in all", note))
    return facts


def _photos(
    run: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], thumbnails: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Verdict, points, final error and small picture of every photo."""
    final = {row["photo"]: row["mean_px"] for row in rows if row["stage"] == "after BA"}
    return [
        {
            "name": str(photo.get("name")),
            "registered": photo.get("registered") is True,
            "verdict": photo.get("verdict"),
            "points": photo.get("points"),
            "mean_px": final.get(photo.get("name")),
            "thumbnail": thumbnails.get(str(photo.get("name"))),
        }
        for photo in _rows(run.get("photos"))
    ]


def _sections(index: FigureIndex) -> list[_Section]:
    """Sections that have figures, in the order of the page; figures of a section nobody knows go to the end."""
    known = {key for key, _, _ in SECTIONS}
    others = [f for f in index.figures if f.section not in known]
    out = []
    for key, title, text in (*SECTIONS, ("more", "More", "")):
        figures = others if key == "more" else [f for f in index.figures if f.section == key]
        seen: dict[str, int] = {}
        folded = []
        for figure in figures:
            seen[figure.caption] = seen.get(figure.caption, 0) + 1
            if figure.dark is None and seen[figure.caption] > FIGURES_IN_SIGHT:
                folded.append(figure)
        if figures:
            out.append(_Section(key, title, text, [f for f in figures if f not in folded], folded))
    return out


def _stage_totals(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of all photos pooled by stage: sums of points, means weighted by them; no median, which does not pool."""
    out = []
    for stage in dict.fromkeys(row["stage"] for row in rows):
        mine = [r for r in rows if r["stage"] == stage and _is_number(r["mean_px"]) and _is_number(r["points"])]
        points = sum(r["points"] for r in mine)
        total: dict[str, Any] = {"stage": stage, "points": points, "photos": len(mine), "mean_px": None, "rms_px": None}
        total["behind"] = sum(r["behind"] for r in rows if r["stage"] == stage and _is_number(r["behind"]))
        if points:
            total["mean_px"] = sum(r["mean_px"] * r["points"] for r in mine) / points
            if all(_is_number(r["rms_px"]) for r in mine):
                total["rms_px"] = math.sqrt(sum(r["rms_px"] ** 2 * r["points"] for r in mine) / points)
        out.append(total)
    return out


ROW_KEYS = ("stage", "photo", "points", "behind", "mean_px", "median_px", "rms_px", "reason", "observations")


def _rows(value: Any) -> list[dict[str, Any]]:
    """A list of objects, each with every key that the page asks for; anything else is left out."""
    return [dict.fromkeys(ROW_KEYS) | row for row in _list_of(value) if isinstance(row, dict)]


def _object_of(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _list_of(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _camera(camera: Mapping[str, Any]) -> tuple[str, str, str]:
    """Model, size in pixels and parameters of a camera."""
    size = f"{_number(camera.get('width'), 0)} × {_number(camera.get('height'), 0)}"
    return (
        str(camera.get("model", "–")),
        size,
        ", ".join(f"{p:.6g}" for p in _list_of(camera.get("params")) if _is_number(p)),
    )


def _timings(run: Mapping[str, Any], metrics: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Seconds of every stage, in order; a stage named `total` would count twice."""
    stages = _object_of(run.get("seconds"))
    timings = [(_words(str(key)), float(s)) for key, s in stages.items() if _is_number(s) and key != "total"]
    if _is_number(metrics.get("seconds")):
        timings.append(("training", float(metrics["seconds"])))
    return timings


def _views(metrics: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Name, PSNR and SSIM of every held-out view."""
    views = _object_of(metrics.get("views"))
    return [(str(name), _object_of(v).get("psnr"), _object_of(v).get("ssim")) for name, v in views.items()]


def _data_uri(folder: Path, name: str) -> str:
    """An image of the folder as a data URI.

    Raises:
        InputError: It is missing, or a link out of the folder.
    """
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise InputError(f"{path}: the index of figures names it, but it is no file; remove the folder and run again")
    return f"data:{MIME[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _number(value: Any, digits: int) -> str:
    """A number with separators of thousands; anything that is none as a dash."""
    return f"{value:,.{digits}f}" if _is_number(value) else "–"


def _seconds(value: Any) -> str:
    """Seconds as people say them."""
    if not _is_number(value):
        return "–"
    if value < 60:
        return f"{value:.1f} s"
    minutes, seconds = divmod(round(value), 60)
    return f"{minutes} min {seconds:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _bar(value: Any, largest: float) -> float:
    """Length of a bar between 0 and 100, on a square-root scale, so that small values stay visible."""
    return (
        round(100.0 * math.sqrt(min(max(value / largest, 0.0), 1.0)), 1) if _is_number(value) and largest > 0 else 0.0
    )


def _words(key: str) -> str:
    return key.replace("_", " ")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
