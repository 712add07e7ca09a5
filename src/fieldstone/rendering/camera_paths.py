"""Camera paths from the poses of the photos alone: around what they look at, a spiral, or through them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.geometry import rotation
from fieldstone.geometry.rigid3 import Rigid3, look_at

FULL_CIRCLE_GAP_DEG = 120.0
"""Photos with no gap wider than this around the scene surround it: the path is a full circle, else an arc."""


def focus_point(cam_from_world: Rigid3) -> Float[np.ndarray, "3"]:
    """The point nearest to the optical axes: minimises sum |(I - d d^T) (x - c)|^2 over centres c and axes d.

    Where the axes are parallel the point is not determined along them, and where they diverge it lies behind the
    photos; it is then taken as far in front of the mean centre as the centres spread.
    """
    centers, axes = cam_from_world.target_origin_in_source(), cam_from_world.R[:, 2]
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    A = projectors.mean(axis=0)
    mean_center = centers.mean(axis=0)
    spread = float(np.linalg.norm(centers - mean_center, axis=1).mean()) or 1.0
    # A little weight on the point in front, which decides only what the axes leave open.
    prior = mean_center + spread * _unit(axes.mean(axis=0))
    weight = 1e-6
    b = np.einsum("vij,vj->i", projectors, centers) / len(centers)
    focus = np.linalg.solve(A + weight * np.eye(3), b + weight * prior)
    depths = np.einsum("vi,vi->v", axes, focus - centers)
    return focus if np.median(depths) > 0 else prior


def up_direction(cam_from_world: Rigid3) -> Float[np.ndarray, "3"]:
    """Upwards, if the photos were held level: the unit vector most nearly perpendicular to all their x axes.

    Minimises the mean of (x . u)^2 less 1e-4 (m . u)^2, with m the mean upward direction of the photos: m decides
    the sign, and the direction where the x axes alone leave it open.
    """
    right, mean_up = cam_from_world.R[:, 0], -cam_from_world.R[:, 1].mean(axis=0)
    A = right.T @ right / len(right) - 1e-4 * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(A).eigenvectors[:, 0]
    return up if up @ mean_up >= 0 else -up


def orbit(cam_from_world: Rigid3, num_frames: int) -> Rigid3:
    """Around what the photos look at, upright, at their mean distance from the axis and their mean height.

    A full circle where the photos surround the scene; otherwise to and fro over the arc that they cover, because a
    field knows nothing of the side that no photo shows.
    """
    centers = cam_from_world.target_origin_in_source()
    focus, up = focus_point(cam_from_world), up_direction(cam_from_world)
    east = _any_perpendicular(up)
    north = np.cross(up, east)
    offsets = centers - focus
    azimuth = np.arctan2(offsets @ north, offsets @ east)
    radius = float(np.hypot(offsets @ north, offsets @ east).mean())
    height = float((offsets @ up).mean())
    first, extent = _covered_arc(azimuth)
    phase = np.arange(num_frames) / num_frames
    if extent < 2 * np.pi:
        phase = (1 - np.cos(2 * np.pi * phase)) / 2
    angles = first + extent * phase
    path = [focus + radius * (np.cos(a) * east + np.sin(a) * north) + height * up for a in angles]
    return Rigid3.stack([look_at(center, focus, up) for center in path])


def spiral(cam_from_world: Rigid3, num_frames: int, *, turns: int = 2) -> Rigid3:
    """Loops about the photo in the middle while looking at what the photos look at: for scenes seen from one side.

    The loops reach as far as the photos spread along that photo's axes (one standard deviation), at least 2 % and at
    most 15 % of the distance to the scene.

    Source:
        The render path of `mildenhall2020` for forward-facing scenes, from poses alone.
    """
    centers = cam_from_world.target_origin_in_source()
    focus = focus_point(cam_from_world)
    middle = cam_from_world[int(np.argmin(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))]
    up = -middle.R[1]
    distance = float(np.linalg.norm(focus - middle.target_origin_in_source()))
    reach = np.clip(middle.apply(centers).std(axis=0), 0.02 * distance, 0.15 * distance)
    phase = 2 * np.pi * np.arange(num_frames) / num_frames
    loops = np.stack([np.cos(turns * phase), np.sin(turns * phase), 0.5 * np.sin(phase)], axis=1)
    path = middle.inverse().apply(loops * reach)
    return Rigid3.stack([look_at(center, focus, up) for center in path])


def through(cam_from_world: Rigid3, num_frames: int) -> Rigid3:
    """From the first pose to the last through all of them: centres on a Catmull-Rom curve, shortest rotations."""
    centers = cam_from_world.target_origin_in_source()
    last = len(centers) - 1
    if last == 0:
        return Rigid3.stack([cam_from_world[0]] * num_frames)
    padded = np.concatenate([centers[:1], centers, centers[-1:]])
    poses = []
    for s in np.linspace(0, last, num_frames):
        k = min(int(s), last - 1)
        u = s - k
        before, a, b, after = padded[k : k + 4]
        center = a + 0.5 * u * (
            b - before + u * (2 * before - 5 * a + 4 * b - after + u * (3 * (a - b) + after - before))
        )
        R0, R1 = cam_from_world.R[k], cam_from_world.R[k + 1]
        R = rotation.exp(u * rotation.log(R1 @ R0.T)) @ R0
        poses.append(Rigid3(R, -R @ center))
    return Rigid3.stack(poses)


def _covered_arc(azimuth: Float[np.ndarray, "v"]) -> tuple[float, float]:
    """First angle and extent (radians) of the arc that the angles cover; 2 pi where their gaps are small."""
    ordered = np.sort(np.mod(azimuth, 2 * np.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= np.deg2rad(FULL_CIRCLE_GAP_DEG):
        return float(ordered[0]), 2 * np.pi
    return float(ordered[(widest + 1) % len(ordered)]), float(2 * np.pi - gaps[widest])


def _any_perpendicular(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))


def _unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return v / np.linalg.norm(v)
