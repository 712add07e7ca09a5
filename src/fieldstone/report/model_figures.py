"""Figures of cameras and points in space: the four poses, from above, in perspective, before and after adjustment."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial import KDTree

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.rotation import angle_between, nearest_rotation
from fieldstone.geometry.sim3 import Sim3
from fieldstone.mapping.record import InitialPair
from fieldstone.report.theme import (
    FONT,
    LIGHT,
    Theme,
    evenly,
    label,
    mixed,
    new_figure,
    readable_colors,
    set_title,
    style_axes,
    style_legend,
)
from fieldstone.scene.alignment import common_poses, transformed
from fieldstone.scene.reconstruction import Reconstruction

MOST_NAMES = 30
"""With more cameras than this, names would cover each other and are left out."""
MOST_POINTS = 50_000
"""Of more points than this, evenly chosen ones are drawn: a figure has fewer pixels."""
HALF_IN = (5.6, 4.6)
PRIOR_OF_MEAN_UP = 0.01
"""Weight of the mean upward axis, beside the mean square of what the rightward axes have along up."""
NAME_PT = 8.5
NAME_OFFSETS = ((0, -1), (1, 0), (-1, 0), (0, 1), *((dx, dy) for dy in (-1, 1, -2, 2) for dx in (1, -1)))
"""Places for a name around its camera, the best first: widths of the name to the right, heights up."""


def four_poses_figure(initial: InitialPair, names: tuple[str, str], *, theme: Theme = LIGHT) -> Figure:
    """The candidate poses from above, in the first camera's frame: x to the right, z (its viewing direction) up."""
    figure = new_figure(11.2, 3.5, theme)
    count = len(initial.candidates)
    for k, (pose, points) in enumerate(zip(initial.candidates, initial.points, strict=True)):
        axes = figure.add_axes(((k + 0.16) / count, 0.14, 0.8 / count, 0.7))
        front = in_front_of_both(pose, points)
        style_axes(axes, theme, x="x", y="z" if k == 0 else "")
        for mask, color, name in ((~front, theme.bad, "behind"), (front, theme.good, "front")):
            axes.scatter(*points[mask][:, [0, 2]].T, s=4, c=color, alpha=0.6, linewidths=0, gid=name)
        cameras = Rigid3.stack([Rigid3.identity(), pose])
        centers, directions = cameras.target_origin_in_source()[:, [0, 2]], cameras.R[:, 2][:, [0, 2]]
        _set_limits(axes, points[:, [0, 2]], centers, spread=(8.0, 92.0))
        reach = 0.2 * float(np.ptp(axes.get_xlim()))
        tips = [centers, centers + reach * directions, centers - 0.3 * reach * directions]
        _set_limits(axes, points[:, [0, 2]], np.concatenate(tips), spread=(8.0, 92.0))
        for number, color in ((0, theme.first), (1, theme.second)):
            _plan_camera(axes, cameras[number], reach, color, str(number + 1))
        is_chosen = k == initial.chosen
        mark = "chosen: " if is_chosen else ""
        total = int(np.isfinite(points[:, 0]).sum())
        set_title(axes, f"{mark}{int(initial.in_front[k])} of {total} in front", theme)
        axes.title.set_gid("title")
        if is_chosen:
            for spine in axes.spines.values():
                spine.set(visible=True, color=theme.good, linewidth=2.2)
    figure.text(
        0.012, 0.955, f"camera 1: {label(names[0])}, camera 2: {label(names[1])}",
        color=theme.muted, fontsize=9, family=FONT, parse_math=False,
    )  # fmt: skip
    return figure


def in_front_of_both(cam2_from_cam1: Rigid3, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points (first camera's frame) lie in front of both cameras."""
    return (points[:, 2] > 0) & (cam2_from_cam1.apply(points)[:, 2] > 0)


def from_above_figure(model: Reconstruction, *, theme: Theme = LIGHT) -> Figure:
    """Cameras and points from above: the mean upward direction of the photos points at the reader."""
    figure = new_figure(*HALF_IN, theme)
    axes = figure.add_axes((0.11, 0.11, 0.86, 0.86))
    style_axes(axes, theme, x="right (scene units)", y="forward (scene units)")
    plan_from_world = upright_frame(model)
    drawn = evenly(len(model.points), MOST_POINTS)
    points = model.points.xyz[drawn] @ plan_from_world.T
    by_height = np.argsort(points[:, 2], kind="stable")
    colors = readable_colors(model.points.rgb[drawn], theme)
    axes.scatter(*points[by_height, :2].T, s=5, c=colors[by_height], linewidths=0, alpha=0.9, gid="points")
    size = frustum_size(model)
    edges = all_frusta(model, size) @ plan_from_world.T
    axes.add_collection(LineCollection(list(edges[:, :, :2]), colors=theme.first, linewidths=0.9, gid="frusta"))
    _set_limits(axes, points[:, :2], edges.reshape(-1, 3)[:, :2])
    _names(axes, model, model.camera_centers() @ plan_from_world.T, theme)
    return figure


def perspective_figure(model: Reconstruction, *, theme: Theme = LIGHT) -> Figure:
    """Cameras and points in perspective, from behind and above the cameras; near points are larger."""
    figure = new_figure(*HALF_IN, theme)
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set_axis_off()
    eye_from_world = viewpoint(model)
    drawn = evenly(len(model.points), MOST_POINTS)
    points = eye_from_world.apply(model.points.xyz[drawn])
    visible = np.flatnonzero(points[:, 2] > 0.05 * np.median(points[:, 2]) if len(points) else [])
    far_to_near = visible[np.argsort(-points[visible, 2], kind="stable")]
    pixels = _plane(points[far_to_near])
    nearness = np.median(points[visible, 2]) / points[far_to_near, 2] if len(visible) else np.empty(0)
    colors = readable_colors(model.points.rgb[drawn], theme)[far_to_near]
    axes.scatter(*pixels.T, s=np.clip(7.0 * nearness**2, 1.5, 40.0), c=colors, linewidths=0, gid="points")
    edges = eye_from_world.apply(all_frusta(model, frustum_size(model)))
    edges = edges[np.all(edges[:, :, 2] > 0, axis=1)]
    lines = _plane(edges.reshape(-1, 3)).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(lines), colors=theme.first, linewidths=1.0, gid="frusta"))
    _set_limits(axes, pixels, lines.reshape(-1, 2), y_down=True, margin=1.14)
    centers = eye_from_world.apply(model.camera_centers())
    _names(axes, model, np.concatenate([_plane(centers), centers[:, 2:]], axis=1), theme)
    return figure


def bundle_overlay_figure(before: Reconstruction, after: Reconstruction, *, theme: Theme = LIGHT) -> Figure:
    """Cameras and points from above before and after bundle adjustment, and how far each camera moved.

    The model before is first brought onto the model after by `similarity_between`: that much is free and says nothing.

    Raises:
        ValueError: Fewer than two views are registered in both.
    """
    before = transformed(before, similarity_between(before, after))
    figure = new_figure(11.2, 4.4, theme)
    axes = figure.add_axes((0.06, 0.12, 0.5, 0.78))
    style_axes(axes, theme, title="from above", x="right (scene units)", y="forward (scene units)")
    plan_from_world, size = upright_frame(after), frustum_size(after)
    frusta, points = [], []
    for model, color, name in ((before, theme.second, "before"), (after, theme.first, "after")):
        points.append(model.points.xyz[evenly(len(model.points), MOST_POINTS)] @ plan_from_world.T)
        frusta.append((all_frusta(model, size) @ plan_from_world.T)[:, :, :2])
        axes.scatter(*points[-1][:, :2].T, s=4, c=color, linewidths=0, alpha=0.55, gid=f"points-{name}")
        axes.add_collection(
            LineCollection(list(frusta[-1]), colors=color, linewidths=1.0, label=name, gid=f"frusta-{name}")
        )
    _set_limits(axes, np.concatenate(points)[:, :2], np.concatenate(frusta).reshape(-1, 2))
    style_legend(axes, theme)

    poses_before, poses_after, names = common_poses(before, after)
    centers_before, centers_after = poses_before.target_origin_in_source(), poses_after.target_origin_in_source()
    extent = float(np.linalg.norm(np.ptp(centers_after, axis=0)))
    moved = 100.0 * np.linalg.norm(centers_before - centers_after, axis=1) / max(extent, 1e-300)
    turned = np.rad2deg(angle_between(poses_before.R, poses_after.R))
    shown = np.sort(np.argsort(-moved, kind="stable")[:20])[::-1]
    for k, (value, title) in enumerate(((moved, "moved (% of camera span)"), (turned, "turned (deg)"))):
        bars = figure.add_axes((0.655 + 0.18 * k, 0.12, 0.15, 0.78))
        style_axes(bars, theme, grid=False)
        set_title(bars, title, theme, size=9.0)
        bars.barh(np.arange(len(shown)), value[shown], color=theme.first, height=0.6, gid=f"moves-{k}")
        bars.set_yticks(np.arange(len(shown)))
        bars.set_yticklabels([label(names[i], 16) if k == 0 else "" for i in shown], parse_math=False)
        bars.set_xlim(0, max(1.15 * float(value[shown].max(initial=0.0)), 1e-12))
        bars.xaxis.set_major_locator(MaxNLocator(3))
    return figure


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
    to_nearest = KDTree(centers).query(centers, k=2)[0][:, 1]
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


def _set_limits(
    axes: Axes,
    points: Float[np.ndarray, "n 2"],
    always: Float[np.ndarray, "m 2"],
    *,
    y_down: bool = False,
    margin: float = 1.08,
    spread: tuple[float, float] = (4.0, 96.0),
) -> None:
    """Equal units on both axes; the box of `always` and of the points without the outermost per cent of each axis."""
    finite = points[np.all(np.isfinite(points), axis=1)]
    bulk = np.percentile(finite, spread, axis=0) if len(finite) else np.empty((0, 2))
    both = np.concatenate([bulk, always])
    lower, upper = (both.min(axis=0), both.max(axis=0)) if len(both) else (np.zeros(2), np.ones(2))
    center, half = (lower + upper) / 2, np.maximum((upper - lower) / 2, 1e-9) * margin
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    width, height = axes.get_position().size * figure.get_size_inches()
    unit = max(half[0] / width, half[1] / height)
    half = unit * np.array([width, height])
    axes.set_xlim(center[0] - half[0], center[0] + half[0])
    y = (center[1] - half[1], center[1] + half[1])
    axes.set_ylim(y[::-1] if y_down else y)


def _plan_camera(axes: Axes, cam_from_world: Rigid3, reach: float, color: str, name: str) -> None:
    """A camera from above (x, z): its centre, an opening of 50 deg and its viewing direction."""
    center = cam_from_world.target_origin_in_source()[[0, 2]]
    forward = cam_from_world.R[2][[0, 2]]
    side = np.array([-forward[1], forward[0]]) * np.tan(np.deg2rad(25.0))
    corners = [center, center + reach * 0.6 * (forward + side), center + reach * 0.6 * (forward - side), center]
    axes.plot(*np.array(corners).T, color=color, linewidth=1.4, zorder=4)
    axes.annotate(
        "", tuple(center + reach * forward), xytext=tuple(center), zorder=4,
        arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip
    axes.annotate(
        name, tuple(center), xytext=(-3, -4), textcoords="offset points", ha="right", va="top",
        color=color, fontsize=10, weight="bold", family=FONT, zorder=5,
    )  # fmt: skip


def _names(axes: Axes, model: Reconstruction, positions: Float[np.ndarray, "r k"], theme: Theme) -> None:
    """Names beside the cameras, where they cover no other name; those without room are left out."""
    views = model.registered().tolist()
    if len(views) > MOST_NAMES:
        return
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    points_per_dot = 72.0 / figure.dpi
    on_page = axes.transData.transform(positions[:, :2]) * points_per_dot
    left, bottom, right, top = (np.array(axes.bbox.extents) * points_per_dot).tolist()
    taken: list[tuple[float, float, float, float]] = []
    for view, position, (x, y) in zip(views, positions, on_page.tolist(), strict=True):
        name = label(model.views[view].name, 16)
        width, height = 0.66 * NAME_PT * len(name), 1.3 * NAME_PT
        for dx, dy in NAME_OFFSETS:
            x0, y0 = x + dx * (12 + width / 2) - width / 2, y + dy * 14 - height / 2
            box = (x0, y0, x0 + width, y0 + height)
            is_inside = left <= x0 and box[2] <= right and bottom <= y0 and box[3] <= top
            if is_inside and not any(_overlap(box, other) for other in taken):
                break
        else:
            continue
        taken.append(box)
        axes.annotate(
            name, (position[0], position[1]), xytext=(dx * (12 + width / 2), dy * 14), textcoords="offset points",
            ha="center", va="center", color=mixed(theme.first, theme.ink, 0.35), fontsize=NAME_PT, family=FONT,
            parse_math=False, annotation_clip=True, zorder=5, gid="name",
            arrowprops={"arrowstyle": "-", "color": theme.muted, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 1},
        )  # fmt: skip


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
