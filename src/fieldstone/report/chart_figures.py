"""Charts: errors by stage, matches between photos, track lengths, training, rendered against true views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from fieldstone.mapping.record import StageRecord
from fieldstone.report.theme import (
    FONT,
    LIGHT,
    LIGHTBOX,
    PHOTO_DPI,
    Theme,
    label,
    luminance,
    mixed,
    new_figure,
    set_title,
    style_axes,
    style_legend,
)
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import Observations

COMPARISONS = (
    ("Triangulation", ("linear triangulation", "non-linear triangulation")),
    ("Poses of further photos", ("linear PnP", "PnP RANSAC", "non-linear PnP")),
    ("Bundle adjustment", ("before BA", "after BA")),
)
"""Stages that belong side by side."""

DIFFERENCE_GAIN = 4.0
MOST_LABELLED = 12


def error_histograms_figure(records: Sequence[StageRecord], *, theme: Theme = LIGHT) -> Figure:
    """Histograms of the reprojection errors of all photos, stages that belong together in one panel; log axis."""
    figure = new_figure(11.2, 3.5, theme)
    bins = np.geomspace(0.01, 100.0, 49)
    recorded = {record.stage for record in records if len(record.errors())}
    panels = [(title, stages) for title, stages in COMPARISONS if recorded & set(stages)]
    for k, (title, stages) in enumerate(panels):
        axes = figure.add_axes((0.05 + k * 0.965 / len(panels), 0.15, 0.965 / len(panels) - 0.04, 0.74))
        style_axes(axes, theme, title=title, x="reprojection error (px)", y="observations" if k == 0 else "")
        for stage, color in zip(stages, (theme.second, theme.third, theme.first)[-len(stages) :], strict=True):
            errors = errors_of(records, stage)
            if not len(errors):
                continue  # the other stages of the panel are there
            counts, _ = np.histogram(np.clip(errors, bins[0], bins[-1]), bins)
            name = f"{stage}, median {np.median(errors):.2f}"
            axes.stairs(counts, bins, fill=True, color=color, alpha=0.22)
            axes.stairs(counts, bins, color=color, linewidth=1.5, label=name, gid=stage)
        axes.set_xscale("log")
        axes.set_xlim(bins[0], bins[-1])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.minorticks_off()
        axes.set_ylim(0, axes.get_ylim()[1] * 1.28)
        style_legend(axes, theme, location="upper left")
    return figure


def errors_of(records: Sequence[StageRecord], stage: str) -> Float[np.ndarray, "n"]:
    """Reprojection errors in pixels of all records of one stage."""
    return np.concatenate([record.errors() for record in records if record.stage == stage] or [np.empty(0)])


def match_matrix_figure(graph: MatchGraph, *, theme: Theme = LIGHT) -> Figure:
    """Matches between every two photos: above the diagonal as given, below it those kept by RANSAC."""
    figure = new_figure(5.6, 4.6, theme)
    axes = figure.add_axes((0.17, 0.12, 0.7, 0.82))
    style_axes(axes, theme, grid=False)
    counts = match_counts(graph)
    ramp = LinearSegmentedColormap.from_list("matches", [mixed(theme.paper, theme.first, 0.06), theme.first])
    image = axes.imshow(np.ma.masked_equal(counts, 0), cmap=ramp, vmin=0, vmax=max(int(counts.max(initial=0)), 1))
    n = graph.num_images
    ticks = np.arange(n) if n <= MOST_LABELLED else np.linspace(0, n - 1, 6).astype(np.int64)
    names = [label(graph.names[i], 14) for i in ticks]
    axes.set_xticks(ticks)
    axes.set_xticklabels(names, rotation=30 if n > 5 else 0, ha="right" if n > 5 else "center", parse_math=False)
    axes.set_yticks(ticks)
    axes.set_yticklabels(names, parse_math=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    if n <= MOST_LABELLED:
        for i, j in np.argwhere(counts > 0).tolist():
            cell = luminance(to_hex(ramp(counts[i, j] / counts.max())))
            color = max((theme.paper, theme.ink), key=lambda c: abs(luminance(c) - cell))
            axes.text(j, i, str(counts[i, j]), ha="center", va="center", color=color, fontsize=8.5, family=FONT)
    else:
        bar = figure.colorbar(image, cax=figure.add_axes((0.9, 0.2, 0.02, 0.66)))
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        bar.ax.tick_params(colors=theme.muted, labelsize=8, length=0)
    return figure


def match_counts(graph: MatchGraph) -> Int[np.ndarray, "n n"]:
    """Entry (i, j), i < j: putative matches; entry (j, i): those that agree with the pair's geometry."""
    counts = np.zeros((graph.num_images, graph.num_images), dtype=np.int64)
    for i, j in graph.matches:
        counts[i, j] = len(graph.matches[i, j])
        counts[j, i] = len(graph.inlier_matches((i, j)))
    return counts


def track_lengths_figure(observations: Observations, *, theme: Theme = LIGHT) -> Figure:
    """In how many photos the points are seen."""
    figure = new_figure(5.6, 4.6, theme)
    axes = figure.add_axes((0.13, 0.12, 0.84, 0.8))
    style_axes(axes, theme, x="photos that see the point", y="points")
    axes.grid(False, axis="x")
    lengths = np.bincount(observations.point) if len(observations) else np.zeros(3, dtype=np.int64)
    counts = np.bincount(lengths[lengths > 0], minlength=3)
    length = np.arange(2, len(counts))
    bars = axes.bar(length, counts[2:], color=theme.first, width=0.7, gid="lengths")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(length) <= MOST_LABELLED:
        axes.bar_label(bars, color=theme.muted, fontsize=8.5, padding=2, family=FONT)
    return figure


def training_figure(curve: Sequence[Mapping[str, Any]], *, theme: Theme = LIGHT) -> Figure:
    """Loss and PSNR over the seconds of training; entries without a finite value are left out."""
    figure = new_figure(11.2, 3.4, theme)
    panels = (("loss", "training loss", theme.second), ("psnr", "PSNR (dB)", theme.first))
    for k, (key, name, color) in enumerate(panels):
        axes = figure.add_axes((0.06 + 0.5 * k, 0.16, 0.42, 0.72))
        style_axes(axes, theme, x="seconds", title=name)
        rows = [
            (row["seconds"], row[key]) for row in curve if _is_number(row.get(key)) and _is_number(row.get("seconds"))
        ]
        if not rows:
            axes.text(0.5, 0.5, "not recorded", transform=axes.transAxes, ha="center", color=theme.muted, family=FONT)
            continue
        seconds, values = np.array(rows, dtype=np.float64).T
        marker = "o" if len(rows) <= 40 else ""
        axes.plot(seconds, values, color=color, linewidth=1.4, marker=marker, markersize=3.5, gid=key)
        if key == "loss" and values.min() > 0 and values.max() > 20 * values.min():
            axes.set_yscale("log")
        if key == "psnr":
            axes.annotate(
                f"{values[-1]:.2f} dB", (seconds[-1], values[-1]), xytext=(-4, -14), textcoords="offset points",
                ha="right", color=theme.ink, fontsize=9, family=FONT,
            )  # fmt: skip
    return figure


def rendered_views_figure(
    views: Sequence[tuple[str, UInt8[np.ndarray, "_ _ 3"], UInt8[np.ndarray, "_ _ 3"], str]],
    *,
    theme: Theme = LIGHTBOX,
) -> Figure:
    """Rows of (name, true view, rendered view, score): the true view, the rendered one, and their difference.

    The difference is the mean over channels of |rendered - true|, drawn `DIFFERENCE_GAIN` times as strong.

    Raises:
        ValueError: No view, or two images that differ in size.
    """
    if not views:
        raise ValueError("a figure of rendered views needs at least one view")
    for name, true, rendered, _ in views:
        if true.shape != rendered.shape:
            raise ValueError(f"view {name!r} is {true.shape} and was rendered at {rendered.shape}")
    width, gap, margin, title = 10.8, 0.12, 0.12, 0.34
    column = (width - 2 * margin - 2 * gap) / 3
    heights = [column * true.shape[0] / true.shape[1] for _, true, _, _ in views]
    total = sum(heights) + len(views) * title + margin
    figure = new_figure(width, total, theme, dpi=PHOTO_DPI)
    top = total
    for (name, true, rendered, score), height in zip(views, heights, strict=True):
        top -= title
        panels = (
            (label(name), true),
            (f"rendered: {score}" if score else "rendered", rendered),
            (f"difference ×{DIFFERENCE_GAIN:g}", difference_image(true, rendered)),
        )
        for k, (text, image) in enumerate(panels):
            left = margin + k * (column + gap)
            axes = figure.add_axes((left / width, (top - height) / total, column / width, height / total))
            small_image = image.shape[1] < column * PHOTO_DPI
            axes.imshow(image, interpolation="nearest" if small_image else "antialiased", aspect="auto")
            axes.set_axis_off()
            set_title(axes, text, theme, size=9.5)
        top -= height
    return figure


def difference_image(
    true: UInt8[np.ndarray, "h w 3"], rendered: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """|rendered - true|, mean over channels, times `DIFFERENCE_GAIN`, from black over red to white."""
    difference = np.abs(rendered.astype(np.int16) - true).mean(axis=2) / 255.0
    colors = colormaps["inferno"](np.clip(DIFFERENCE_GAIN * difference, 0.0, 1.0))
    return np.round(255.0 * colors[:, :, :3]).astype(np.uint8)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
