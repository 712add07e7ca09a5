"""Figures on photos: matches, epipolar lines, reprojections.

Photos are drawn in pixel coordinates, corner convention, whatever size their pixels are stored at; a photo that is
not at hand is a plain rectangle of its camera's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, Stroke

from fieldstone.geometry.camera import Camera, image_from_plane, plane_from_image
from fieldstone.geometry.epipolar import homogeneous
from fieldstone.mapping.record import StageRecord
from fieldstone.report.theme import (
    DRAWN_PX,
    FONT,
    LIGHTBOX,
    PHOTO_DPI,
    Theme,
    evenly,
    label,
    new_figure,
    set_title,
    small,
)
from fieldstone.scene.match_graph import ImagePair, MatchGraph

MaybePhoto = UInt8[np.ndarray, "_ _ 3"] | None

WIDTH_IN = 10.8
GAP_PX_SHARE = 0.015
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500)


def matches_figure(
    graph: MatchGraph,
    pair: ImagePair,
    cameras: tuple[Camera, Camera],
    photos: tuple[MaybePhoto, MaybePhoto],
    *,
    max_lines: int = 160,
    theme: Theme = LIGHTBOX,
) -> Figure:
    """Putative matches of a pair (above), and what RANSAC made of them (below): kept green, rejected red.

    Both rows draw the same matches, evenly chosen where there are more than `max_lines`; titles count all.
    """
    inlier = _inlier_mask(graph, pair)
    pixels1, pixels2 = graph.matched_pixels(pair)
    chosen = evenly(len(inlier), max_lines)
    canvas = _side_by_side(cameras)
    figure, rows = _panels([canvas, canvas], 1, theme)
    segments = np.stack([_placed(pixels1[chosen], cameras, 0), _placed(pixels2[chosen], cameras, 1)], axis=1)
    kept = inlier[chosen]
    drawn = "" if len(chosen) == len(inlier) else f", {len(chosen)} drawn"
    names = f"{label(graph.names[pair[0]])} – {label(graph.names[pair[1]])}"
    rejected = len(inlier) - int(inlier.sum())
    titles = (
        f"before RANSAC: {len(inlier)} matches{drawn}   {names}",
        f"after RANSAC: {int(inlier.sum())} kept (green), {rejected} rejected (red)",
    )
    for axes, title in zip(rows, titles, strict=True):
        for side in (0, 1):
            _show_photo(axes, photos[side], _extent(cameras, side), theme)
        set_title(axes, title, theme)
    _add_lines(rows[0], segments, theme.second, "putative")
    _add_lines(rows[1], segments[~kept], theme.bad, "rejected")
    _add_lines(rows[1], segments[kept], theme.good, "kept")
    return figure


def epipolar_figure(
    graph: MatchGraph,
    pair: ImagePair,
    cameras: tuple[Camera, Camera],
    photos: tuple[MaybePhoto, MaybePhoto],
    *,
    max_lines: int = 12,
    theme: Theme = LIGHTBOX,
) -> Figure:
    """Points of the first photo, and in the second the lines on which their matches must lie, in the same colours.

    With lens distortion the lines are curves: they are drawn through the camera model.

    Raises:
        ValueError: The pair has no epipolar geometry.
    """
    E = essential_of(graph, pair, cameras)
    pixels1, pixels2 = graph.matched_pixels(pair, graph.inlier_matches(pair))
    chosen = _spread_out(pixels1, max_lines)
    figure, axes = _panels([_size(c) for c in cameras], 2, theme)
    colors = colormaps["turbo"](np.linspace(0.06, 0.94, max(len(chosen), 1)))[: len(chosen)]
    for side, pixels in enumerate((pixels1, pixels2)):
        _show_photo(axes[side], photos[side], _whole(cameras[side]), theme)
        axes[side].scatter(
            *pixels[chosen].T, s=34, c=colors, edgecolors="white", linewidths=0.8, zorder=4, gid=f"points-{side}"
        )
    for color, curve in zip(colors, epipolar_curves(E, cameras, pixels1[chosen]), strict=True):
        axes[1].plot(*curve.T, color=color, linewidth=1.3, zorder=3, gid="epipolar-line")
    _mark_epipole(axes[1], epipole(E, cameras[1]), cameras[1], theme)
    distance = distance_to_curves(E, cameras, pixels1, pixels2)
    typical = f", median distance {np.median(distance):.2f} px of {len(distance)} matches" if len(distance) else ""
    set_title(axes[0], f"points in {label(graph.names[pair[0]])}", theme)
    set_title(axes[1], f"their lines in {label(graph.names[pair[1]])}{typical}", theme)
    return figure


def reprojections_figure(
    records: Sequence[StageRecord],
    camera: Camera,
    photo: MaybePhoto,
    *,
    max_points: int = 350,
    theme: Theme = LIGHTBOX,
) -> Figure:
    """One photo at two or more stages: observed pixels as crosses, error vectors to dots, the reprojections.

    Vectors are drawn `magnification` times as long as they are, alike in all panels, so that panels compare.
    """
    scale = magnification(records, camera.width)
    figure, panels = _panels([_size(camera)] * len(records), len(records), theme)
    for axes, record in zip(panels, records, strict=True):
        _show_photo(axes, photo, _whole(camera), theme)
        in_front = np.isfinite(record.reprojected[:, 0])
        ahead = np.flatnonzero(in_front)
        ahead = ahead[evenly(len(ahead), max_points)]
        observed = record.pixels[ahead]
        ends = observed + scale * (record.reprojected[ahead] - observed)
        axes.add_collection(
            LineCollection(
                list(np.stack([observed, ends], axis=1)), colors=theme.second, linewidths=0.9, gid="error-vectors"
            )
        )
        axes.scatter(*observed.T, s=13, marker="x", c=theme.first, linewidths=0.8, zorder=3, gid="observed")
        axes.scatter(*ends.T, s=5, c=theme.second, linewidths=0, zorder=4, gid="reprojected")
        behind = record.pixels[~in_front]
        axes.scatter(*behind.T, s=16, marker="s", facecolors="none", edgecolors=theme.bad, linewidths=0.9, gid="behind")
        row = record.as_row()
        mean = "no point in front" if row["mean_px"] is None else f"mean {row['mean_px']:.2f} px"
        unseen = f", {row['behind']} behind" if row["behind"] else ""
        magnified = f", vectors ×{scale}" if len(records) < 3 or axes is panels[0] else ""
        size = 10.0 if len(records) < 3 else 8.5
        set_title(axes, f"{record.stage}: {mean}, {row['points']} points{unseen}{magnified}", theme, size=size)
    return figure


def magnification(records: Sequence[StageRecord], width_px: int) -> int:
    """How much longer to draw error vectors: a round number at which the worst stage's median is 1/40 of the photo."""
    medians = [float(np.median(errors)) for record in records if len(errors := record.errors())]
    wanted = width_px / 40.0 / max(max(medians, default=1.0), 1e-9)
    return max((m for m in MAGNIFICATIONS if m <= wanted), default=1)


def essential_of(graph: MatchGraph, pair: ImagePair, cameras: tuple[Camera, Camera]) -> Float[np.ndarray, "3 3"]:
    """The pair's relation between ideal coordinates on the planes z = 1: y^T E x = 0.

    Raises:
        ValueError: The pair has no epipolar geometry.
    """
    two_view = graph.two_views.get(pair)
    if two_view is not None and two_view.kind == "calibrated":
        return two_view.matrix
    if two_view is not None and two_view.kind == "uncalibrated":
        return cameras[1].calibration_matrix().T @ two_view.matrix @ cameras[0].calibration_matrix()
    kind = "unverified" if two_view is None else two_view.kind
    raise ValueError(f"pair {pair} is {kind}: it has no epipolar lines")


def epipolar_curves(
    E: Float[np.ndarray, "3 3"], cameras: tuple[Camera, Camera], pixels1: Float[np.ndarray, "n 2"]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Pixels of the second photo along the epipolar line of each pixel of the first; empty where it misses the photo.

    A line of the plane z = 1 is cut to the part that the photo shows and sent through the camera model.
    """
    lines = homogeneous(plane_from_image(cameras[0], pixels1)) @ E.T
    lower, upper = _visible_plane(cameras[1])
    curves = []
    for line in lines:
        ends = _cut_to_box(line, lower, upper)
        if ends is None:
            curves.append(np.empty((0, 2)))
            continue
        along = np.linspace(0.0, 1.0, 200)[:, None]
        curves.append(image_from_plane(cameras[1], ends[0] + along * (ends[1] - ends[0])))
    return curves


def distance_to_curves(
    E: Float[np.ndarray, "3 3"],
    cameras: tuple[Camera, Camera],
    pixels1: Float[np.ndarray, "n 2"],
    pixels2: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n"]:
    """Distance in pixels of each match to its epipolar line in the second photo, lens distortion undone."""
    lines = homogeneous(plane_from_image(cameras[0], pixels1)) @ E.T @ np.linalg.inv(cameras[1].calibration_matrix())
    ideal = plane_from_image(cameras[1], pixels2) * cameras[1].focal + cameras[1].principal_point
    return np.abs(np.sum(lines * homogeneous(ideal), axis=1)) / np.linalg.norm(lines[:, :2], axis=1)


def epipole(E: Float[np.ndarray, "3 3"], camera2: Camera) -> Float[np.ndarray, "3"]:
    """Where the second photo sees the first camera: homogeneous ideal pixels (z = 0: at infinity)."""
    left_null = np.linalg.svd(E)[0][:, 2]
    return camera2.calibration_matrix() @ left_null


def _mark_epipole(axes: Axes, point: Float[np.ndarray, "3"], camera: Camera, theme: Theme) -> None:
    """A star at the epipole, or an arrow at the border towards it."""
    size = np.array([camera.width, camera.height])
    outline = [Stroke(linewidth=2.5, foreground=theme.paper), Normal()]
    style = {"color": theme.ink, "fontsize": 8.5, "family": FONT, "path_effects": outline}
    is_finite = abs(point[2]) > 1e-9 * np.linalg.norm(point)
    pixel = point[:2] / point[2] if is_finite else np.full(2, np.inf)
    if np.all((pixel >= 0) & (pixel <= size)):
        uv = (pixel - camera.principal_point) / camera.focal
        x, y = image_from_plane(camera, uv[None])[0]
        axes.scatter([x], [y], s=110, marker="*", c=theme.ink, edgecolors="black", zorder=5, gid="epipole")
        axes.annotate("epipole", (x, y), xytext=(8, 4), textcoords="offset points", zorder=5, **style)
        return
    direction = pixel - size / 2 if is_finite else point[:2]
    direction = direction / np.linalg.norm(direction)
    reach = np.min((size / 2 * 0.97) / np.maximum(np.abs(direction), 1e-9))
    tip, tail = size / 2 + reach * direction, size / 2 + (reach - 0.09 * camera.width) * direction
    arrow = {"arrowstyle": "-|>", "color": theme.ink, "linewidth": 1.6}
    axes.annotate("", tuple(tip), xytext=tuple(tail), arrowprops=arrow, zorder=5, gid="epipole")
    axes.annotate(
        "to the epipole", tuple(tail), xytext=(-6 * direction[0], 9 + 9 * abs(direction[1])),
        textcoords="offset points", ha="right" if direction[0] > 0 else "left", zorder=5, **style,
    )  # fmt: skip


def _panels(sizes: Sequence[tuple[float, float]], columns: int, theme: Theme) -> tuple[Figure, list[Axes]]:
    """Axes in rows of `columns`, each as wide as the others and as tall as its size asks, with room for a title."""
    title_in, gap_in, margin_in = 0.34, 0.12, 0.12
    width = (WIDTH_IN - 2 * margin_in - (columns - 1) * gap_in) / columns
    rows = [sizes[k : k + columns] for k in range(0, len(sizes), columns)]
    heights = [max(width * h / w for w, h in row) for row in rows]
    total = sum(heights) + len(rows) * title_in + margin_in + (len(rows) - 1) * gap_in
    figure = new_figure(WIDTH_IN, total, theme, dpi=PHOTO_DPI)
    panels, top = [], total
    for row, height in zip(rows, heights, strict=True):
        top -= title_in
        for k, (w, h) in enumerate(row):
            left, own = margin_in + k * (width + gap_in), width * h / w
            axes = figure.add_axes((left / WIDTH_IN, (top - own) / total, width / WIDTH_IN, own / total))
            axes.set(xlim=(0, w), ylim=(h, 0))
            axes.set_axis_off()
            panels.append(axes)
        top -= height + gap_in
    return figure, panels


def _show_photo(axes: Axes, photo: MaybePhoto, extent: tuple[float, float, float, float], theme: Theme) -> None:
    """The photo, dimmed so that what is drawn on it stands out."""
    limits = axes.get_xlim(), axes.get_ylim()
    if photo is None:
        x, width, height, y = extent[0], extent[1] - extent[0], extent[2] - extent[3], extent[3]
        axes.add_patch(Rectangle((x, y), width, height, facecolor=theme.grid, edgecolor="none"))
    else:
        dimmed = (small(photo, DRAWN_PX) * np.float32(0.6)).astype(np.uint8)
        axes.imshow(dimmed, extent=extent, interpolation="antialiased", aspect="auto", zorder=0)
    axes.set(xlim=limits[0], ylim=limits[1])


def _whole(camera: Camera) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of a photo by itself."""
    return 0.0, float(camera.width), float(camera.height), 0.0


def _size(camera: Camera) -> tuple[float, float]:
    return float(camera.width), float(camera.height)


def _side_by_side(cameras: tuple[Camera, Camera]) -> tuple[float, float]:
    """Width and height of a canvas with both photos at the height of the taller one."""
    _, right, height, _ = _extent(cameras, 1)
    return right, height


def _extent(cameras: tuple[Camera, Camera], side: int) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of a photo on the common canvas."""
    height = float(max(c.height for c in cameras))
    widths = [c.width * height / c.height for c in cameras]
    left = 0.0 if side == 0 else widths[0] + GAP_PX_SHARE * sum(widths)
    return left, left + widths[side], height, 0.0


def _placed(pixels: Float[np.ndarray, "n 2"], cameras: tuple[Camera, Camera], side: int) -> Float[np.ndarray, "n 2"]:
    """Pixels of a photo on the common canvas."""
    left, _, height, _ = _extent(cameras, side)
    return pixels * (height / cameras[side].height) + np.array([left, 0.0])


def _add_lines(axes: Axes, segments: Float[np.ndarray, "n 2 2"], color: str, gid: str) -> None:
    axes.add_collection(LineCollection(list(segments), colors=color, linewidths=0.8, alpha=0.75, gid=gid))
    ends = segments.reshape(-1, 2)
    axes.scatter(*ends.T, s=5, c=color, linewidths=0, zorder=3)


def _inlier_mask(graph: MatchGraph, pair: ImagePair) -> np.ndarray:
    two_view = graph.two_views.get(pair)
    return np.ones(len(graph.matches[pair]), dtype=bool) if two_view is None else two_view.inliers


def _spread_out(pixels: Float[np.ndarray, "n 2"], count: int) -> Int[np.ndarray, "k"]:
    """Indices of at most `count` pixels far from each other, sorted from top to bottom.

    Starts with the one nearest to the mean, then always takes the one farthest from those taken.
    """
    if not len(pixels):
        return np.empty(0, dtype=np.int64)
    chosen = [int(np.argmin(np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(pixels - pixels[chosen[0]], axis=1)
    while len(chosen) < min(count, len(pixels)) and distance.max() > 0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
    return np.array(sorted(chosen, key=lambda k: (pixels[k, 1], pixels[k, 0])), dtype=np.int64)


def _visible_plane(camera: Camera) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The box of the plane z = 1 that the photo's border spans; ideal where the lens has no inverse."""
    s = np.linspace(0.0, 1.0, 33)[:, None]
    w, h = camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h], [0.0, 0.0]])
    border = np.concatenate([a + s * (b - a) for a, b in pairwise(corners)])
    plane = plane_from_image(camera, border)
    ideal = (border - camera.principal_point) / camera.focal
    plane = np.where(np.isfinite(plane), plane, ideal)
    return plane.min(axis=0), plane.max(axis=0)


def _cut_to_box(
    line: Float[np.ndarray, "3"], lower: Float[np.ndarray, "2"], upper: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """Where the line a x + b y + c = 0 enters and leaves a box; None if it misses."""
    normal_squared = float(line[:2] @ line[:2])
    if not normal_squared > 0 or not np.all(np.isfinite(line)):
        return None
    foot = -line[2] * line[:2] / normal_squared
    direction = np.array([-line[1], line[0]]) / np.sqrt(normal_squared)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (lower - foot) / direction, (upper - foot) / direction
    parallel = direction == 0
    if np.any(parallel & ((foot < lower) | (foot > upper))):
        return None
    enter = np.where(parallel, -np.inf, np.minimum(a, b)).max()
    leave = np.where(parallel, np.inf, np.maximum(a, b)).min()
    return None if enter >= leave else (foot + enter * direction, foot + leave * direction)
