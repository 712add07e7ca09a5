"""Small bundle problems with everything in them: shared, own and held cameras, held views and points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.solve.bundle.problem import BundleProblem, updated

CAMERAS = (
    Camera("SIMPLE_RADIAL", 800, 600, np.array([700.0, 400, 300, -0.05])),
    Camera("OPENCV", 640, 480, np.array([500.0, 510, 320, 240, -0.1, 0.02, 1e-3, -1e-3])),
    Camera("PINHOLE", 640, 480, np.array([520.0, 510, 320, 240])),
)


def mixed_problem(
    *,
    num_views: int = 6,
    num_points: int = 30,
    noise_px: float = 0.5,
    fixed: bool = True,
    reach: int | None = None,
    seed: int = 0,
) -> BundleProblem:
    """Cameras on an arc around a cloud, every point seen by some of them, pixels with Gaussian noise.

    View 1 has a camera of its own (OPENCV); the others share SIMPLE_RADIAL and PINHOLE. Parameters are refined in
    patterns that leave gaps. With `fixed`, view 2 and point 3 are held. With `reach`, a point is seen only by views
    up to that many steps from its own place on a ring of views: the reduced camera system is then sparse.
    """
    rng = np.random.default_rng(seed)
    camera_of_view = np.where(np.arange(num_views) == 1, 1, np.where(np.arange(num_views) % 3 == 2, 2, 0))
    omega = np.stack([0.1 * rng.normal(size=num_views), np.linspace(0, 2, num_views), np.zeros(num_views)], axis=1)
    poses = Rigid3(exp(omega), np.tile([0.0, 0.0, 6.0], (num_views, 1)) + 0.3 * rng.normal(size=(num_views, 3)))
    points = rng.uniform(-1, 1, size=(num_points, 3))
    seen = rng.random((num_views, num_points)) < 0.8
    seen[:2] = True
    if reach is not None:
        place = np.arange(num_points) * num_views // num_points
        apart = np.abs(np.arange(num_views)[:, None] - place)
        seen = np.minimum(apart, num_views - apart) <= reach
    view, point = np.nonzero(seen)
    shuffled = rng.permutation(len(view))
    view, point = view[shuffled], point[shuffled]
    pixels = np.concatenate(
        [
            image_from_cam(CAMERAS[camera_of_view[i]], poses[i].apply(points[j : j + 1]))
            for i, j in zip(view, point, strict=True)
        ]
    )
    return BundleProblem(
        cameras=CAMERAS,
        camera_of_view=camera_of_view,
        cam_from_world=poses,
        points=points,
        view=view,
        point=point,
        pixels=pixels + noise_px * rng.normal(size=pixels.shape),
        fixed_views=(np.arange(num_views) == 2) & fixed,
        fixed_points=(np.arange(num_points) == 3) & fixed,
        refine=(
            np.array([True, False, False, True]),
            np.array([True, True, False, False, True, False, True, True]),
            np.array([True, True, True, False]),
        ),
    )


def perturbed(problem: BundleProblem, *, scale: float = 1.0, seed: int = 1) -> BundleProblem:
    """The problem started away from the truth, fixed parts untouched."""
    rng = np.random.default_rng(seed)
    return updated(
        problem,
        scale * 0.02 * rng.normal(size=(problem.num_views, 6)) * ~problem.fixed_views[:, None],
        scale * 0.05 * rng.normal(size=problem.points.shape) * ~problem.fixed_points[:, None],
        tuple(
            scale * 0.01 * camera.params * rng.normal(size=len(mask)) * mask
            for camera, mask in zip(problem.cameras, problem.refine, strict=True)
        ),
    )


def without_refinement(problem: BundleProblem) -> BundleProblem:
    """The problem with all intrinsics held."""
    return replace(problem, refine=tuple(np.zeros_like(mask) for mask in problem.refine))
