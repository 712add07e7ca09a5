"""Figures of cameras and points in space: the four poses, from above, in perspective, before and after adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.rotation import angle_between, nearest_rotation
from fieldstone.geometry.sim3 import Sim3
from fieldstone.geometry.triangulation import in_front_of_both
from fieldstone.report import raster, svg
from fieldstone.report.panel import Panel, axes, ticks, title
from fieldstone.report.theme import LIGHT, LIGHTBOX, Theme, evenly, label, mixed, readable_colors, rgb_of
from fieldstone.scene.alignment import common_poses, transformed
from fieldstone.scene.mapping_run import InitialPair
from fieldstone.scene.reconstruction import Reconstruction

MOST_NAMES = 30
"""With more cameras than this, names would cover each other and are left out."""
MOST_POINTS = 50_000
"""Of more points than this, evenly chosen ones are drawn: a figure has fewer pixels."""
PLAN_POINTS = 10_000
"""The same for the overlay, whose points are drawn one by one."""
HALF = (560.0, 460.0)
"""Page units of a figure as wide as half of the page."""
MOST_BARS = 20
CLOUD_SCALE = 2.0
"""Pixels of a cloud per page unit."""
CLOUD_QUALITY = 88
PRIOR_OF_MEAN_UP = 0.01
"""Weight of the mean upward axis, beside the mean square of what the rightward axes have along up."""
NAME_SIZE = 11.5
NAME_OFFSETS = ((0, -1), (1, 0), (-1, 0), (0, 1), *((dx, dy) for dy in (-1, 1, -2, 2) for dx in (1, -1)))
"""Places for a name around its camera, the best first: widths of the name to the right, heights up."""


def four_poses_figure(initial: InitialPair, names: tuple[str, str], *, theme: Theme = LIGHT) -> str:
    """The candidate poses from above, in the first camera's frame: x to the right, z (its viewing direction) up."""
    width, height, count = 1120.0, 350.0, len(initial.candidates)
    parts = [
        svg.text((14.0, 20.0), f"camera 1: {label(names[0])}, camera 2: {label(names[1])}", theme.muted, name="names")
    ]
    for k, (pose, points) in enumerate(zip(initial.candidates, initial.points, strict=True)):
        column = width / count
        box = Panel((k + 0.16) * column, 56.0, 0.8 * column, 245.0)
        front = in_front_of_both(pose, points)
        plan = points[:, [0, 2]]
        cameras = Rigid3.stack([Rigid3.identity(), pose])
        centers, directions = cameras.target_origin_in_source()[:, [0, 2]], cameras.R[:, 2][:, [0, 2]]
        reach = 0.2 * float(np.ptp(_fitted(box, plan, centers, spread=(8.0, 92.0)).x))
        tips = [centers, centers + reach * directions, centers - 0.3 * reach * directions]
        panel = _fitted(box, plan, np.concatenate(tips), spread=(8.0, 92.0))
        inside = [
            svg.dots(panel.place(plan[mask]), color, 2.4, name)
            for mask, color, name in ((~front, theme.bad, "behind"), (front, theme.good, "front"))
        ]
        for number, color in ((0, theme.first), (1, theme.second)):
            inside.append(_plan_camera(panel, cameras[number], reach, color, str(number + 1)))
        is_chosen = k == initial.chosen
        total = int(np.isfinite(points[:, 0]).sum())
        words = f"{'chosen: ' if is_chosen else ''}{int(initial.in_front[k])} of {total} in front"
        frame = axes(panel, theme, x="x", y="z" if k == 0 else "", equal_units=True)
        parts += [frame, panel.clipped(inside), title(panel, words, theme)]
        if is_chosen:
            parts.append(svg.rectangle(panel.box, "none", "chosen", outline=theme.good, width=2.6))
    return svg.page(width, height, theme, parts)


def from_above_figure(model: Reconstruction, *, theme: Theme = LIGHTBOX) -> str:
    """Cameras and points from above: the mean upward direction of the photos points at the reader."""
    plan_from_world = upright_frame(model)
    drawn = evenly(len(model.points), MOST_POINTS)
    points = model.points.xyz[drawn] @ plan_from_world.T
    by_height = np.argsort(points[:, 2], kind="stable")
    edges = (all_frusta(model, frustum_size(model)) @ plan_from_world.T)[:, :, :2]
    panel = _fitted(Panel(62.0, 14.0, HALF[0] - 79.0, HALF[1] - 64.0), points[:, :2], edges.reshape(-1, 2))
    colors = readable_colors(model.points.rgb[drawn], theme)
    inside = (
        _cloud(panel, points[by_height, :2], np.full(len(points), 3.2), colors[by_height], theme),
        axes(panel, theme, x="right (scene units)", y="forward (scene units)", equal_units=True),
        panel.clipped([svg.segments(panel.place(edges), theme.first, 1.3, "frusta")]),
        _names(panel, model, panel.place((model.camera_centers() @ plan_from_world.T)[:, :2]), theme),
    )
    return svg.page(*HALF, theme, inside)


def perspective_figure(model: Reconstruction, *, theme: Theme = LIGHTBOX) -> str:
    """Cameras and points in perspective, from behind and above the cameras; near points are larger."""
    eye_from_world = viewpoint(model)
    drawn = evenly(len(model.points), MOST_POINTS)
    points = eye_from_world.apply(model.points.xyz[drawn])
    visible = np.flatnonzero(points[:, 2] > 0.05 * np.median(points[:, 2]) if len(points) else [])
    far_to_near = visible[np.argsort(-points[visible, 2], kind="stable")]
    plane = _plane(points[far_to_near])
    nearness = np.median(points[visible, 2]) / points[far_to_near, 2] if len(visible) else np.empty(0)
    edges = eye_from_world.apply(all_frusta(model, frustum_size(model)))
    edges = edges[np.all(edges[:, :, 2] > 0, axis=1)]
    lines = _plane(edges.reshape(-1, 3)).reshape(-1, 2, 2)
    panel = _fitted(Panel(0.0, 0.0, *HALF), plane, lines.reshape(-1, 2), y_down=True, margin=1.14)
    colors = readable_colors(model.points.rgb[drawn], theme)[far_to_near]
    inside = (
        _cloud(panel, plane, np.clip(3.7 * nearness, 1.7, 8.8), colors, theme),
        panel.clipped([svg.segments(panel.place(lines), theme.first, 1.4, "frusta")]),
        _names(panel, model, panel.place(_plane(eye_from_world.apply(model.camera_centers()))), theme),
    )
    return svg.page(*HALF, theme, inside)


def bundle_overlay_figure(before: Reconstruction, after: Reconstruction, *, theme: Theme = LIGHT) -> str:
    """Cameras and points from above before and after bundle adjustment, and how far each camera moved.

    The model before is first brought onto the model after by `similarity_between`: that much is free and says nothing.

    Raises:
        ValueError: Fewer than two views are registered in both.
    """
    before = transformed(before, similarity_between(before, after))
    plan_from_world, size = upright_frame(after), frustum_size(after)
    clouds, frusta = [], []
    for model in (before, after):
        clouds.append((model.points.xyz[evenly(len(model.points), PLAN_POINTS)] @ plan_from_world.T)[:, :2])
        frusta.append((all_frusta(model, size) @ plan_from_world.T)[:, :, :2])
    panel = _fitted(Panel(67.0, 40.0, 540.0, 345.0), np.concatenate(clouds), np.concatenate(frusta).reshape(-1, 2))
    shown = (("before", theme.second, 3.0, clouds[0], frusta[0]), ("after", theme.first, 2.2, clouds[1], frusta[1]))
    inside = [
        piece
        for name, color, diameter, cloud, lines in shown
        for piece in (
            svg.dots(panel.place(cloud), color, diameter, f"points-{name}"),
            svg.segments(panel.place(lines), color, 1.4, f"frusta-{name}"),
        )
    ]
    parts = [
        axes(panel, theme, x="right (scene units)", y="forward (scene units)", equal_units=True),
        panel.clipped(inside),
        title(panel, "from above", theme),
    ]
    for k, (name, color, *_) in enumerate(shown):
        x, y = panel.right - 140.0 + 76.0 * k, panel.top - 13.0
        parts.append(svg.dots([(x - 9.0, y)], color, 9.0, "legend"))
        parts.append(svg.text((x, y + 4.0), name, theme.ink))
    return svg.page(1120.0, 440.0, theme, [*parts, _moves(before, after, theme)])


def _moves(before: Reconstruction, after: Reconstruction, theme: Theme) -> str:
    """Bars of how far the cameras moved and turned: those that moved most, in the order of the photos."""
    poses_before, poses_after, names = common_poses(before, after)
    centers_before, centers_after = poses_before.target_origin_in_source(), poses_after.target_origin_in_source()
    extent = float(np.linalg.norm(np.ptp(centers_after, axis=0)))
    moved = 100.0 * np.linalg.norm(centers_before - centers_after, axis=1) / max(extent, 1e-300)
    turned = np.rad2deg(angle_between(poses_before.R, poses_after.R))
    shown = np.sort(np.argsort(-moved, kind="stable")[:MOST_BARS])
    parts = []
    for k, (value, words) in enumerate(((moved, "moved (% of camera span)"), (turned, "turned (deg)"))):
        largest = max(1.15 * float(value[shown].max(initial=0.0)), 1e-12)
        panel = Panel(732.0 + 206.0 * k, 40.0, 164.0, 345.0, x=(0.0, largest), y=(len(shown) - 0.5, -0.5))
        marks = ticks(panel.x, count=4)
        parts += [axes(panel, theme, x_ticks=marks, y_ticks=[], grid=False), title(panel, words, theme, size=12.5)]
        for row, i in enumerate(shown.tolist()):
            (left, top), (right, bottom) = panel.place(np.array([[0.0, row - 0.3], [value[i], row + 0.3]])).tolist()
            parts.append(svg.rectangle((left, top, right - left, bottom - top), theme.first, f"moves-{k}"))
            if k == 0:
                at = (left - 7.0, (top + bottom) / 2 + 4.0)
                parts.append(svg.text(at, label(names[i], 16), theme.muted, size=11.0, anchor="end"))
    return "".join(parts)


def similarity_between(model: Reconstruction, reference: Reconstruction) -> Sim3:
    """`reference_from_model` with the mean relative rotation of the cameras, then scale and shift of their centres.

    Unlike a fit to centres alone it does not turn about the line on which the cameras of a walk along a facade lie.

    Raises:
        ValueError: Fewer than two views are registered in both.
    """
    poses_model, poses_reference, names = common_poses(model, reference)
    if len(names) < 2:
        raise ValueError(f"alignment needs two common registered views, got {len(names)}")
    R = nearest_rotation(np.sum(np.swapaxes(poses_reference.R, 1, 2) @ poses_model.R, axis=0))
    turned = poses_model.target_origin_in_source() @ R.T
    target = poses_reference.target_origin_in_source()
    a, b = turned - turned.mean(axis=0), target - target.mean(axis=0)
    ratio = float(np.sum(a * b)) / max(float(np.sum(a * a)), 1e-300)
    scale = ratio if ratio > 0 else 1.0
    return Sim3(scale, R, target.mean(axis=0) - scale * turned.mean(axis=0))


def upright_frame(model: Reconstruction) -> Float[np.ndarray, "3 3"]:
    """Rows right, forward, up of the scene as its photos see it.

    Photos are mostly taken without roll: up is what is most perpendicular to their axes to the right, and, as far as
    those are parallel and leave it open, the mean of their axes up. Cameras all around a scene have no common
    forward: then that of the first one counts.
    """
    poses = Rigid3.stack([model.pose_of(i) for i in model.registered().tolist()])
    if not len(poses.t):
        return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    mean_up = _unit(-poses.R[:, 1].sum(axis=0), -poses.R[0, 1])
    across_up = np.eye(3) - np.outer(mean_up, mean_up)
    sideways = np.einsum("ni,nj->ij", poses.R[:, 0], poses.R[:, 0]) / len(poses.R)
    up = np.linalg.eigh(sideways + PRIOR_OF_MEAN_UP * across_up)[1][:, 0]
    up = up if up @ mean_up >= 0 else -up
    first = poses.R[0, 2] - (poses.R[0, 2] @ up) * up
    mean = poses.R[:, 2].mean(axis=0)
    across = mean - (mean @ up) * up
    forward = _unit(across if np.linalg.norm(across) > 0.2 else first, poses.R[0, 1] - (poses.R[0, 1] @ up) * up)
    return np.stack([np.cross(forward, up), forward, up])


def viewpoint(model: Reconstruction) -> Rigid3:
    """`eye_from_world` of a look at the whole scene from behind the cameras, above them and a little to the left."""
    right, forward, up = upright_frame(model)
    centers, xyz = model.camera_centers(), model.points.xyz
    seen = np.concatenate([_within_percentiles(xyz, 4.0, 96.0), centers]) if len(xyz) else centers
    target = seen.mean(axis=0) if len(seen) else np.zeros(3)
    radius = float(np.percentile(np.linalg.norm(seen - target, axis=1), 95)) if len(seen) else 1.0
    direction = -0.85 * forward + 0.45 * up - 0.3 * right
    return look_at(target + 3.0 * max(radius, 1e-9) * direction / np.linalg.norm(direction), target, up)


def frustum_size(model: Reconstruction) -> float:
    """Depth to draw camera frusta at: visible beside the scene, but not touching each other."""
    centers, xyz = model.camera_centers(), model.points.xyz
    some = xyz[evenly(len(xyz), 1000)]
    distances = [np.median(np.linalg.norm(some - c, axis=1)) for c in centers] if len(some) else [1.0]
    reach = 0.16 * float(np.median(distances)) if len(distances) else 1.0
    if len(centers) < 2:
        return reach
    to_nearest = [np.partition(np.linalg.norm(centers - c, axis=1), 1)[1] for c in centers[evenly(len(centers), 1000)]]
    return float(np.clip(0.8 * np.median(to_nearest), 0.2 * reach, reach))


def all_frusta(model: Reconstruction, size: float) -> Float[np.ndarray, "e 2 3"]:
    """Edges of the frusta of all registered views in the world, eight per view."""
    edges = [frustum_edges(model.camera_of(i), model.pose_of(i), size) for i in model.registered().tolist()]
    return np.concatenate(edges) if edges else np.empty((0, 2, 3))


def frustum_edges(camera: Camera, cam_from_world: Rigid3, size: float) -> Float[np.ndarray, "8 2 3"]:
    """Edges of the pyramid between the camera's centre and its image at depth `size`, in the world.

    The first four go from the centre to the corners of the ideal image (distortion left out), the others around it.
    """
    w, h = camera.width, camera.height
    corners = (np.array([[0, 0], [w, 0], [w, h], [0, h]]) - camera.principal_point) / camera.focal
    in_world = cam_from_world.inverse().apply(size * np.concatenate([corners, np.ones((4, 1))], axis=1))
    apex = np.broadcast_to(cam_from_world.target_origin_in_source(), (4, 3))
    return np.concatenate(
        [np.stack([apex, in_world], axis=1), np.stack([in_world, np.roll(in_world, -1, axis=0)], axis=1)]
    )


def _cloud(
    panel: Panel,
    points: Float[np.ndarray, "n 2"],
    diameters: Float[np.ndarray, "n"],
    colors: UInt8[np.ndarray, "n 3"],
    theme: Theme,
) -> str:
    """Points in their own colours as one picture, later ones over earlier ones."""
    pixels = raster.dots_on_ground(
        CLOUD_SCALE * (panel.place(points) - [panel.left, panel.top]),
        CLOUD_SCALE * diameters,
        colors,
        (round(CLOUD_SCALE * panel.width), round(CLOUD_SCALE * panel.height)),
        rgb_of(theme.paper),
    )
    return panel.clipped(
        [svg.picture(raster.encode_jpeg(pixels, CLOUD_QUALITY, full_color=True), panel.box, "points")], "cloud"
    )


def _fitted(
    box: Panel,
    points: Float[np.ndarray, "n 2"],
    always: Float[np.ndarray, "m 2"],
    *,
    y_down: bool = False,
    margin: float = 1.08,
    spread: tuple[float, float] = (4.0, 96.0),
) -> Panel:
    """The panel with equal units on both axes that shows `always` and the points without the outermost per cent."""
    finite = points[np.all(np.isfinite(points), axis=1)]
    bulk = np.percentile(finite, spread, axis=0) if len(finite) else np.empty((0, 2))
    both = np.concatenate([bulk, always])
    lower, upper = (both.min(axis=0), both.max(axis=0)) if len(both) else (np.zeros(2), np.ones(2))
    center, half = (lower + upper) / 2, np.maximum((upper - lower) / 2, 1e-9) * margin
    unit = max(half[0] / box.width, half[1] / box.height)
    low, high = center - unit * np.array([box.width, box.height]), center + unit * np.array([box.width, box.height])
    y = (float(high[1]), float(low[1])) if y_down else (float(low[1]), float(high[1]))
    return replace(box, x=(float(low[0]), float(high[0])), y=y)


def _plan_camera(panel: Panel, cam_from_world: Rigid3, reach: float, color: str, name: str) -> str:
    """A camera from above (x, z): its centre, an opening of 50 deg and its viewing direction."""
    center = cam_from_world.target_origin_in_source()[[0, 2]]
    forward = cam_from_world.R[2][[0, 2]]
    side = np.array([-forward[1], forward[0]]) * np.tan(np.deg2rad(25.0))
    corners = [center, center + reach * 0.6 * (forward + side), center + reach * 0.6 * (forward - side), center]
    tail, tip = panel.place(np.stack([center, center + reach * forward]))
    at = (tail[0] - 5.0, tail[1] + 14.0)
    return (
        svg.polyline(panel.place(np.array(corners)), color, 2.0, "camera")
        + svg.arrow(tail, tip, color, 1.7, "direction")
        + svg.text(at, name, color, size=14.0, weight=700, anchor="end", halo="", name="number")
    )


def _names(panel: Panel, model: Reconstruction, on_page: Float[np.ndarray, "r 2"], theme: Theme) -> str:
    """Names beside the cameras, where they cover no other name; those without room are left out."""
    views = model.registered().tolist()
    if len(views) > MOST_NAMES:
        return ""
    color = mixed(theme.first, theme.ink, 0.35)
    taken: list[tuple[float, float, float, float]] = []
    lines, words = [], []
    for view, (x, y) in zip(views, on_page.tolist(), strict=True):
        name = label(model.views[view].name, 16)
        width, height = 0.66 * NAME_SIZE * len(name), 1.3 * NAME_SIZE
        for dx, dy in NAME_OFFSETS:
            center = (x + dx * (16 + width / 2), y - dy * 19)
            box = (center[0] - width / 2, center[1] - height / 2, center[0] + width / 2, center[1] + height / 2)
            is_inside = (
                panel.left <= box[0] and box[2] <= panel.right and panel.top <= box[1] and box[3] <= panel.bottom
            )
            if is_inside and not any(_overlap(box, other) for other in taken):
                break
        else:
            continue
        taken.append(box)
        lines.append([[x, y], [min(max(x, box[0] + 8), box[2] - 8), min(max(y, box[1]), box[3])]])
        at = (center[0], center[1] + 0.35 * NAME_SIZE)
        words.append(svg.text(at, name, color, size=NAME_SIZE, anchor="middle", halo=theme.paper, name="name"))
    return svg.segments(np.array(lines).reshape(-1, 2, 2), theme.muted, 0.8, "leaders") + "".join(words)


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _plane(points_in_eye: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    return points_in_eye[:, :2] / points_in_eye[:, 2:]


def _within_percentiles(xyz: Float[np.ndarray, "n 3"], low: float, high: float) -> Float[np.ndarray, "m 3"]:
    lower, upper = np.percentile(xyz, (low, high), axis=0)
    return xyz[np.all((xyz >= lower) & (xyz <= upper), axis=1)]


def _unit(v: Float[np.ndarray, "3"], otherwise: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    chosen = v if np.linalg.norm(v) > 1e-6 else otherwise
    return chosen / np.linalg.norm(chosen)
