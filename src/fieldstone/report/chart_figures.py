"""Charts: errors by stage, matches between photos, track lengths, training, rendered against true views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.records.field import CurvePoint
from fieldstone.report import raster, svg
from fieldstone.report.panel import TITLE_RISE, Panel, axes, title, whole_ticks
from fieldstone.report.theme import LIGHT, LIGHTBOX, Theme, label, luminance, mixed, rgb_of
from fieldstone.scene.mapping_run import StageRecord
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
MOST_MARKED = 40
"""Longer curves have no dots at their values."""
VIEW_QUALITY = 90
"""Of rendered views, whose faults are what one looks for."""


def error_histograms_figure(records: Sequence[StageRecord], *, theme: Theme = LIGHT) -> str:
    """Histograms of the reprojection errors of all photos, stages that belong together in one panel; log axis."""
    bins = np.geomspace(0.01, 100.0, 49)
    recorded = {record.stage for record in records if len(record.errors())}
    compared = [(words, stages) for words, stages in COMPARISONS if recorded & set(stages)]
    column = 1080.0 / max(len(compared), 1)
    parts = []
    for k, (words, stages) in enumerate(compared):
        shown = []
        for stage, color in zip(stages, (theme.second, theme.third, theme.first)[-len(stages) :], strict=True):
            errors = errors_of(records, stage)
            if len(errors):  # else the other stages of the panel are there
                counts, _ = np.histogram(np.clip(errors, bins[0], bins[-1]), bins)
                shown.append((stage, color, counts, f"{stage}, median {np.median(errors):.2f}"))
        highest = 1.28 * max(int(counts.max()) for _, _, counts, _ in shown)
        panel = Panel(
            62.0 + k * column, 38.0, column - 62.0, 258.0, x=(bins[0], bins[-1]), y=(0.0, highest), log_x=True
        )
        inside = []
        for row, (stage, color, counts, name) in enumerate(shown):
            outline = panel.place(_stairs(counts, bins))
            inside.append(svg.polygon(outline, color, f"{stage}-area", opacity=0.22))
            inside.append(svg.polyline(outline, color, 2.0, stage))
            x, y = panel.left + 14.0, panel.top + 14.0 + 17.0 * row
            inside.append(svg.segments(np.array([[[x, y], [x + 20.0, y]]]), color, 2.4, "legend"))
            inside.append(svg.text((x + 28.0, y + 4.0), name, theme.ink, size=11.5))
        label_y = "observations" if k == 0 else ""
        parts += [axes(panel, theme, x="reprojection error (px)", y=label_y, y_ticks=whole_ticks(panel.y))]
        parts += [title(panel, words, theme), panel.clipped(inside)]
    return svg.page(1120.0, 350.0, theme, parts)


def _stairs(counts: Int[np.ndarray, "n"], borders: Float[np.ndarray, "n+1"]) -> Float[np.ndarray, "m 2"]:
    """The outline of a histogram, from zero to zero."""
    return np.stack([np.repeat(borders, 2), np.concatenate([[0], np.repeat(counts, 2), [0]])], axis=1)


def errors_of(records: Sequence[StageRecord], stage: str) -> Float[np.ndarray, "n"]:
    """Reprojection errors in pixels of all records of one stage."""
    return np.concatenate([record.errors() for record in records if record.stage == stage] or [np.empty(0)])


def match_matrix_figure(graph: MatchGraph, *, theme: Theme = LIGHT) -> str:
    """Matches between every two photos: above the diagonal as given, below it those kept by RANSAC."""
    counts, n = match_counts(graph), graph.num_images
    panel = Panel(100.0, 20.0, 372.0, 372.0, x=(-0.5, n - 0.5), y=(n - 0.5, -0.5))
    low, high = (np.array(rgb_of(c)) for c in (mixed(theme.paper, theme.first, 0.06), theme.first))
    share = counts / max(int(counts.max(initial=0)), 1)
    cells = np.round(low + share[:, :, None] * (high - low)).astype(np.uint8)
    cells[counts == 0] = rgb_of(theme.paper)
    parts = [panel.clipped([svg.picture(raster.encode_png(cells), panel.box, "cells", blocky=True)])]
    shown = range(n) if n <= MOST_LABELLED else np.linspace(0, n - 1, 6).astype(np.int64).tolist()
    for i in shown:
        name = label(graph.names[i], 14)
        x, y = panel.place(np.array([i, i])).tolist()
        parts.append(svg.text((panel.left - 8.0, y + 4.0), name, theme.muted, size=11.0, anchor="end"))
        at, anchor, turned_deg = (
            ((x + 4.0, panel.bottom + 16.0), "end", -30.0) if n > 5 else ((x, panel.bottom + 16.0), "middle", 0.0)
        )
        parts.append(svg.text(at, name, theme.muted, size=11.0, anchor=anchor, turned_deg=turned_deg))
    if n <= MOST_LABELLED:
        for i, j in np.argwhere(counts > 0).tolist():
            cell = "#{:02x}{:02x}{:02x}".format(*cells[i, j].tolist())
            color = max((theme.paper, theme.ink), key=lambda c: abs(luminance(c) - luminance(cell)))
            x, y = panel.place(np.array([j, i])).tolist()
            size = 12.0 if n <= 8 else 10.5
            parts.append(svg.text((x, y + 4.0), str(counts[i, j]), color, size=size, anchor="middle", name="count"))
    else:
        bar = Panel(panel.right + 26.0, 40.0, 12.0, 332.0, y=(0.0, float(counts.max())))
        ramp = np.round(high + np.linspace(0.0, 1.0, 128)[:, None, None] * (low - high)).astype(np.uint8)
        parts.append(svg.picture(raster.encode_png(ramp), bar.box, "ramp"))
        for value in whole_ticks(bar.y):
            _, y = bar.place(np.array([0.0, value])).tolist()
            parts.append(svg.text((bar.right + 6.0, y + 4.0), f"{value:.0f}", theme.muted, size=11.0))
    return svg.page(560.0, 460.0, theme, parts)


def match_counts(graph: MatchGraph) -> Int[np.ndarray, "n n"]:
    """Entry (i, j), i < j: putative matches; entry (j, i): those that agree with the pair's geometry."""
    counts = np.zeros((graph.num_images, graph.num_images), dtype=np.int64)
    for i, j in graph.matches:
        counts[i, j] = len(graph.matches[i, j])
        counts[j, i] = len(graph.inlier_matches((i, j)))
    return counts


def track_lengths_figure(observations: Observations, *, theme: Theme = LIGHT) -> str:
    """In how many photos the points are seen."""
    lengths = np.bincount(observations.point) if len(observations) else np.zeros(3, dtype=np.int64)
    counts = np.bincount(lengths[lengths > 0], minlength=3)[2:]
    longest = len(counts) + 1
    panel = Panel(
        72.0, 30.0, 472.0, 376.0, x=(1.5, longest + 0.5), y=(0.0, 1.08 * max(int(counts.max()), 1))
    )  # fmt: skip
    parts = [
        axes(
            panel, theme, x="photos that see the point", y="points",
            x_ticks=whole_ticks(panel.x, 12), y_ticks=whole_ticks(panel.y),
        )
    ]  # fmt: skip
    for length, count in enumerate(counts.tolist(), start=2):
        corners = panel.place(np.array([[length - 0.35, count], [length + 0.35, 0.0]]))
        (left, top), (right, bottom) = corners.tolist()
        parts.append(svg.rectangle((left, top, right - left, bottom - top), theme.first, "lengths"))
        if len(counts) <= MOST_LABELLED:
            at = ((left + right) / 2, top - 5.0)
            parts.append(svg.text(at, str(count), theme.muted, size=11.0, anchor="middle", name="count"))
    return svg.page(560.0, 460.0, theme, parts)


def training_figure(curve: Sequence[CurvePoint], *, theme: Theme = LIGHT) -> str:
    """Loss and PSNR over the seconds of training; steps without a finite value are left out."""
    parts = []
    losses, psnrs = [(p.seconds, p.loss) for p in curve], [(p.seconds, p.psnr) for p in curve]
    for k, (key, words, color, series) in enumerate(
        (("loss", "training loss", theme.second, losses), ("psnr", "PSNR (dB)", theme.first, psnrs))
    ):
        rows = [point for point in series if np.isfinite(point).all()]
        panel = Panel(68.0 + 560.0 * k, 40.0, 470.0, 244.0)
        if not rows:
            center = (panel.left + panel.width / 2, panel.top + panel.height / 2)
            parts.append(svg.text(center, "not recorded", theme.muted, anchor="middle"))
            parts += [axes(panel, theme, x_ticks=[], y_ticks=[]), title(panel, words, theme)]
            continue
        values = np.array(rows, dtype=np.float64)
        low, high = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        is_log = key == "loss" and low[1] > 0 and high[1] > 20 * low[1]
        y = (low[1] / 1.3, high[1] * 1.3) if is_log else _widened(low[1], high[1])
        panel = replace(panel, x=_widened(low[0], high[0]), y=y, log_y=is_log)
        on_page = panel.place(values)
        inside = [svg.polyline(on_page, color, 1.9, key)]
        if len(rows) <= MOST_MARKED:
            inside.append(svg.dots(on_page, color, 5.0, f"{key}-values"))
        if key == "psnr":
            at = (on_page[-1, 0] - 5.0, on_page[-1, 1] + 20.0)
            inside.append(svg.text(at, f"{values[-1, 1]:.2f} dB", theme.ink, anchor="end"))
        parts += [axes(panel, theme, x="seconds"), title(panel, words, theme), panel.clipped(inside)]
    return svg.page(1120.0, 340.0, theme, parts)


def _widened(low: float, high: float) -> tuple[float, float]:
    """Limits with some room around the values."""
    room = 0.05 * (high - low) or max(abs(low), 1.0) * 0.05
    return low - room, high + room


def rendered_views_figure(
    views: Sequence[tuple[str, UInt8[np.ndarray, "_ _ 3"], UInt8[np.ndarray, "_ _ 3"], str]],
    *,
    theme: Theme = LIGHTBOX,
) -> str:
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
    width, gap, margin = 1080.0, 12.0, 12.0
    column = (width - 2 * margin - 2 * gap) / 3
    parts, top = [], 0.0
    for name, true, rendered, score in views:
        top += 34.0
        height = column * true.shape[0] / true.shape[1]
        panels = (
            (label(name), true),
            (f"rendered: {score}" if score else "rendered", rendered),
            (f"difference ×{DIFFERENCE_GAIN:g}", difference_image(true, rendered)),
        )
        for k, (words, image) in enumerate(panels):
            left = margin + k * (column + gap)
            encoded = raster.encode_jpeg(raster.small(image, raster.DRAWN_PX), VIEW_QUALITY, full_color=True)
            parts.append(svg.text((left, top - TITLE_RISE), words, theme.ink, size=12.5, name="title"))
            is_small = image.shape[1] < column
            parts.append(svg.picture(encoded, (left, top, column, height), "view", blocky=is_small))
        top += height
    return svg.page(width, top + margin, theme, parts)


def difference_image(
    true: UInt8[np.ndarray, "h w 3"], rendered: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """|rendered - true|, mean over channels, times `DIFFERENCE_GAIN`, from black over red to white."""
    difference = np.abs(rendered.astype(np.int16) - true).mean(axis=2) / 255.0
    return raster.color_ramp(DIFFERENCE_GAIN * difference, cv2.COLORMAP_INFERNO)
