"""Figures on photos: matches, epipolar lines, reprojections.

Photos are drawn in pixel coordinates, corner convention, whatever size their pixels are stored at; a photo that is
not at hand is a plain rectangle of its camera's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.geometry.camera import Camera, image_from_plane, plane_from_image
from fieldstone.geometry.epipolar import homogeneous
from fieldstone.report import raster, svg
from fieldstone.report.panel import Panel, title
from fieldstone.report.theme import LIGHTBOX, Theme, evenly, label
from fieldstone.scene.mapping_run import StageRecord
from fieldstone.scene.match_graph import ImagePair, MatchGraph

MaybePhoto = UInt8[np.ndarray, "_ _ 3"] | None
Extent = tuple[float, float, float, float]
"""(left, right, bottom, top)."""

WIDTH, MARGIN, GAP, TITLE = 1080.0, 12.0, 12.0, 34.0
"""Page units: of the figure, around and between its photos, above each row."""
GAP_PX_SHARE = 0.015
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
LONGEST_VECTOR = 4.0 * WIDTH
"""Page units; longer error vectors leave the photo anyway."""


def matches_figure(
    graph: MatchGraph,
    pair: ImagePair,
    cameras: tuple[Camera, Camera],
    photos: tuple[MaybePhoto, MaybePhoto],
    *,
    max_lines: int = 160,
    theme: Theme = LIGHTBOX,
) -> str:
    """Putative matches of a pair (above), and what RANSAC made of them (below): kept green, rejected red.

    Both rows draw the same matches, evenly chosen where there are more than `max_lines`; titles count all.
    """
    inlier = _inlier_mask(graph, pair)
    pixels1, pixels2 = graph.matched_pixels(pair)
    chosen = evenly(len(inlier), max_lines)
    canvas = _side_by_side(cameras)
    height, rows = _panels([canvas, canvas], 1)
    segments = np.stack([_placed(pixels1[chosen], cameras, 0), _placed(pixels2[chosen], cameras, 1)], axis=1)
    kept = inlier[chosen]
    drawn = "" if len(chosen) == len(inlier) else f", {len(chosen)} drawn"
    names = f"{label(graph.names[pair[0]])} – {label(graph.names[pair[1]])}"
    rejected = len(inlier) - int(inlier.sum())
    titles = (
        f"before RANSAC: {len(inlier)} matches{drawn} \N{MIDDLE DOT} {names}",
        f"after RANSAC: {int(inlier.sum())} kept (green), {rejected} rejected (red)",
    )
    lines = (
        (("putative", segments, theme.second),),
        (("rejected", segments[~kept], theme.bad), ("kept", segments[kept], theme.good)),
    )
    extents = [_extent(cameras, side) for side in (0, 1)]
    parts = [_photo(rows[0], photos[side], extents[side], f"photo-{side}", theme) for side in (0, 1)]
    for panel, words, groups in zip(rows, titles, lines, strict=True):
        inside = [svg.used(f"photo-{side}", _corner(panel, extents[side])) for side in (0, 1)]
        for name, ends, color in groups:
            on_page = panel.place(ends)
            inside.append(svg.segments(on_page, color, 1.1, name, opacity=0.75))
            inside.append(svg.dots(on_page.reshape(-1, 2), color, 3.4, f"{name}-ends"))
        parts += [title(panel, words, theme), panel.clipped(inside)]
    return svg.page(WIDTH, height, theme, parts)


def epipolar_figure(
    graph: MatchGraph,
    pair: ImagePair,
    cameras: tuple[Camera, Camera],
    photos: tuple[MaybePhoto, MaybePhoto],
    *,
    max_lines: int = 12,
    theme: Theme = LIGHTBOX,
) -> str:
    """Points of the first photo, and in the second the lines on which their matches must lie, in the same colours.

    With lens distortion the lines are curves: they are drawn through the camera model.

    Raises:
        ValueError: The pair has no epipolar geometry.
    """
    E = essential_of(graph, pair, cameras)
    pixels = graph.matched_pixels(pair, graph.inlier_matches(pair))
    chosen = _spread_out(pixels[0], max_lines)
    distance = distance_to_curves(E, cameras, *pixels)
    typical = f", median distance {np.median(distance):.2f} px of {len(distance)} matches" if len(distance) else ""
    first, second = (label(graph.names[k]) for k in pair)
    titles = (f"points in {first}", f"their lines in {second}{typical}")
    height, panels = _panels([_size(c) for c in cameras], 2)
    ramp = raster.color_ramp(np.linspace(0.06, 0.94, max(len(chosen), 1)), cv2.COLORMAP_TURBO)
    colors = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in ramp[: len(chosen)].tolist()]
    extents = [_whole(camera) for camera in cameras]
    parts = [_photo(panels[side], photos[side], extents[side], f"photo-{side}", theme) for side in (0, 1)]
    for side, (panel, words) in enumerate(zip(panels, titles, strict=True)):
        inside = [svg.used(f"photo-{side}", _corner(panel, extents[side]))]
        if side == 1:
            for color, curve in zip(colors, epipolar_curves(E, cameras, pixels[0][chosen]), strict=True):
                inside.append(svg.polyline(panel.place(curve), color, 1.8, "epipolar-line"))
        for color, center in zip(colors, panel.place(pixels[side][chosen]).tolist(), strict=True):
            inside.append(svg.circle((center[0], center[1]), 8.5, color, f"point-{side}", outline="white", width=1.1))
        if side == 1:
            inside.append(_epipole_mark(panel, epipole(E, cameras[1]), cameras[1], theme))
        parts += [title(panel, words, theme), panel.clipped(inside)]
    return svg.page(WIDTH, height, theme, parts)


def reprojections_figure(
    records: Sequence[StageRecord],
    camera: Camera,
    photo: MaybePhoto,
    *,
    max_points: int = 350,
    theme: Theme = LIGHTBOX,
) -> str:
    """One photo at two or more stages: observed pixels as crosses, error vectors to dots, the reprojections.

    Vectors are drawn `magnification` times as long as they are, alike in all panels, so that panels compare.
    """
    scale = magnification(records, camera.width)
    height, panels = _panels([_size(camera)] * len(records), len(records))
    parts = [_photo(panels[0], photo, _whole(camera), "photo-0", theme)]
    for panel, record in zip(panels, records, strict=True):
        in_front = np.isfinite(record.reprojected[:, 0])
        ahead = np.flatnonzero(in_front)
        ahead = ahead[evenly(len(ahead), max_points)]
        observed, reprojected = panel.place(record.pixels[ahead]), panel.place(record.reprojected[ahead])
        vectors = scale * (reprojected - observed)
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        ends = observed + vectors * np.minimum(1.0, LONGEST_VECTOR / np.maximum(length, 1e-9))
        inside = (
            svg.used("photo-0", _corner(panel, _whole(camera))),
            svg.segments(np.stack([observed, ends], axis=1), theme.second, 1.2, "error-vectors"),
            svg.crosses(observed, theme.first, 4.6, 1.1, "observed"),
            svg.dots(ends, theme.second, 3.4, "reprojected"),
            svg.squares(panel.place(record.pixels[~in_front]), theme.bad, 5.5, 1.2, "behind"),
        )
        magnified = f", vectors ×{scale}" if len(records) < 3 or panel is panels[0] else ""
        size = svg.TITLE_SIZE if len(records) < 3 else 12.0
        parts += [title(panel, _stage_title(record) + magnified, theme, size=size), panel.clipped(inside)]
    return svg.page(WIDTH, height, theme, parts)


def _stage_title(record: StageRecord) -> str:
    row = record.row()
    mean = "no point in front" if row.mean_px is None else f"mean {row.mean_px:.2f} px"
    unseen = f", {row.behind} behind" if row.behind else ""
    return f"{record.stage}: {mean}, {row.points} points{unseen}"


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


def _epipole_mark(panel: Panel, point: Float[np.ndarray, "3"], camera: Camera, theme: Theme) -> str:
    """A star at the epipole, or an arrow at the border towards it."""
    size = np.array([camera.width, camera.height])
    is_finite = abs(point[2]) > 1e-9 * np.linalg.norm(point)
    pixel = point[:2] / point[2] if is_finite else np.full(2, np.inf)
    if np.all((pixel >= 0) & (pixel <= size)):
        x, y = panel.place(image_from_plane(camera, ((pixel - camera.principal_point) / camera.focal)[None])[0])
        angle = np.arange(10) * np.pi / 5
        tips = np.stack([np.sin(angle), -np.cos(angle)], axis=1) * np.where(np.arange(10) % 2, 3.2, 8.0)[:, None]
        star = svg.polygon(tips + [x, y], theme.ink, "epipole", outline="black")
        return star + svg.text((x + 11, y - 6), "epipole", theme.ink, size=11.5, halo=theme.paper)
    direction = pixel - size / 2 if is_finite else point[:2]
    direction = direction / np.linalg.norm(direction)
    half = np.array([panel.width, panel.height]) / 2
    center = np.array([panel.left, panel.top]) + half
    tip = center + np.min(half * 0.97 / np.maximum(np.abs(direction), 1e-9)) * direction
    tail = tip - 0.09 * panel.width * direction
    at = (
        tail[0] - 8 * direction[0],
        tail[1] - 12 - 12 * abs(direction[1]) if tail[1] > center[1] - 0.7 * half[1] else tail[1] + 20,
    )
    words = svg.text(
        at, "to the epipole", theme.ink, size=11.5, anchor="end" if direction[0] > 0 else "start", halo=theme.paper
    )
    return svg.arrow(tail, tip, theme.ink, 2.0, "epipole") + words


def _panels(sizes: Sequence[tuple[float, float]], columns: int) -> tuple[float, list[Panel]]:
    """Height of the figure, and rows of `columns` panels, equally wide, as tall as their sizes ask, room for titles.

    A panel's values are the pixels of its size, y down.
    """
    width = (WIDTH - 2 * MARGIN - (columns - 1) * GAP) / columns
    panels, top = [], 0.0
    for first in range(0, len(sizes), columns):
        row = sizes[first : first + columns]
        top += TITLE if not first else TITLE + GAP
        for k, (w, h) in enumerate(row):
            panels.append(Panel(MARGIN + k * (width + GAP), top, width, width * h / w, x=(0.0, w), y=(h, 0.0)))
        top += max(width * h / w for w, h in row)
    return top + MARGIN, panels


def _photo(panel: Panel, photo: MaybePhoto, extent: Extent, key: str, theme: Theme) -> str:
    """A photo, dim so that what is drawn on it stands out, or a plain box where there is none; to be used by key."""
    (left, top), (right, bottom) = _placed_extent(panel, extent)
    box = (0.0, 0.0, right - left, bottom - top)
    if photo is None:
        return svg.defined(svg.rectangle(box, theme.grid, "photo"), key)
    encoded = raster.encode_jpeg(raster.dimmed(raster.small(photo, raster.DRAWN_PX)))
    return svg.defined(svg.picture(encoded, box, "photo"), key)


def _corner(panel: Panel, extent: Extent) -> tuple[float, float]:
    (left, top), _ = _placed_extent(panel, extent)
    return left, top


def _placed_extent(panel: Panel, extent: Extent) -> list[list[float]]:
    """Left upper and right lower corner on the page."""
    left, right, bottom, top = extent
    return panel.place(np.array([[left, top], [right, bottom]])).tolist()


def _whole(camera: Camera) -> Extent:
    """Of a photo by itself."""
    return 0.0, float(camera.width), float(camera.height), 0.0


def _size(camera: Camera) -> tuple[float, float]:
    return float(camera.width), float(camera.height)


def _side_by_side(cameras: tuple[Camera, Camera]) -> tuple[float, float]:
    """Width and height of a canvas with both photos at the height of the taller one."""
    _, right, height, _ = _extent(cameras, 1)
    return right, height


def _extent(cameras: tuple[Camera, Camera], side: int) -> Extent:
    """Of a photo on the common canvas."""
    height = float(max(c.height for c in cameras))
    widths = [c.width * height / c.height for c in cameras]
    left = 0.0 if side == 0 else widths[0] + GAP_PX_SHARE * sum(widths)
    return left, left + widths[side], height, 0.0


def _placed(pixels: Float[np.ndarray, "n 2"], cameras: tuple[Camera, Camera], side: int) -> Float[np.ndarray, "n 2"]:
    """Pixels of a photo on the common canvas."""
    left, _, height, _ = _extent(cameras, side)
    return pixels * (height / cameras[side].height) + np.array([left, 0.0])


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
