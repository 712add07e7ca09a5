"""Bundle problems of known difficulty, made from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.solve.bundle.problem import BundleProblem, updated

RING_RADIUS = 10.0
CLOUD_RADIUS = 3.0


@dataclass(frozen=True)
class RingOptions:
    """Cameras on a ring around a ball of points."""

    num_views: int
    num_points: int
    reach: int
    """A point is seen only by views up to this many steps from its own place on the ring."""
    mean_length: float = 5.0
    """Mean number of observations of a point; at least two."""
    noise_px: float = 0.5
    short_baseline: bool = False
    """The first two cameras stand almost in the same place."""
    per_view_cameras: bool = False
    """Every view refines its own focal length and distortion, rather than all of them one."""


def ring_problem(options: RingOptions, rng: np.random.Generator) -> BundleProblem:
    """A problem started away from the truth: 0.6 deg, 1 % of the ring and 3 % of the cloud, 2 % of the focal length."""
    v, p = options.num_views, options.num_points
    poses = _poses_on_ring(options, rng)
    directions = rng.normal(size=(p, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = CLOUD_RADIUS * rng.random((p, 1)) ** (1 / 3) * directions
    length = np.minimum(2 + rng.poisson(options.mean_length - 2, size=p), 2 * options.reach + 1)
    point = np.repeat(np.arange(p), length)
    away = rng.integers(-options.reach, options.reach + 1, size=len(point))
    place = rng.integers(0, v, size=p)
    rows = np.unique(point * v + (place[point] + away) % v)
    point, view = np.divmod(rows, v)
    # Draws may coincide; what is seen once only is no point for a bundle.
    count = np.bincount(point, minlength=p)
    keep = count[point] >= 2
    points, point, view = points[count >= 2], (np.cumsum(count >= 2) - 1)[point[keep]], view[keep]
    camera = Camera("SIMPLE_RADIAL", 1600, 1200, np.array([1400.0, 800.0, 600.0, -0.05]))
    pixels = image_from_cam(camera, poses[view].apply(points[point]))
    num_cameras = v if options.per_view_cameras else 1
    truth = BundleProblem(
        cameras=(camera,) * num_cameras,
        camera_of_view=np.arange(v) % num_cameras,
        cam_from_world=poses,
        points=points,
        view=view,
        point=point,
        pixels=pixels + options.noise_px * rng.normal(size=pixels.shape),
        fixed_views=np.zeros(v, dtype=bool),
        fixed_points=np.zeros(len(points), dtype=bool),
        refine=(np.array([True, False, False, True]),) * num_cameras,
    )
    tangent = np.concatenate([0.01 * rng.normal(size=(v, 3)), 0.1 * rng.normal(size=(v, 3))], axis=1)
    return updated(
        truth, tangent, 0.1 * rng.normal(size=points.shape), (np.array([30.0, 0.0, 0.0, 0.03]),) * num_cameras
    )


def _poses_on_ring(options: RingOptions, rng: np.random.Generator) -> Rigid3:
    """Cameras on the ring, jittered, looking near its centre."""
    v = options.num_views
    angle = 2 * np.pi * np.arange(v) / v
    centers = RING_RADIUS * np.stack([np.cos(angle), np.zeros(v), np.sin(angle)], axis=1)
    centers += rng.normal(size=(v, 3)) * np.array([0.3, 0.8, 0.3])
    if options.short_baseline:
        centers[1] = centers[0] + 0.01 * rng.normal(size=3)
    forward = _unit(0.3 * rng.normal(size=(v, 3)) - centers)
    right = _unit(np.cross(np.array([0.0, 1.0, 0.0]), forward))
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Rigid3(R, -np.einsum("vij,vj->vi", R, centers))


def _unit(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows of length one."""
    return v / np.linalg.norm(v, axis=1, keepdims=True)
