"""The bundle adjustment problem: which poses, points and intrinsics explain the observed pixels best.

The readable reference of its residuals and analytic Jacobians; solvers work on these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.jacobian import image_from_world_jacobian
from fieldstone.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """Observation k says: view `view[k]` sees point `point[k]` at `pixels[k]`.

    refine: per camera, which of its parameters are free. Fixed views and points keep their values.
    pixel_scale: per view, how many of its pixels count as one: residuals are divided by it before any loss. That is
    the standard deviation of an observation, up to a common factor; a detector that worked on a photo reduced by s
    sees its keypoints to s times as many pixels of the photo. None: one everywhere.
    """

    cameras: tuple[Camera, ...]
    camera_of_view: Int[np.ndarray, "v"]
    cam_from_world: Rigid3
    points: Float[np.ndarray, "p 3"]
    view: Int[np.ndarray, "o"]
    point: Int[np.ndarray, "o"]
    pixels: Float[np.ndarray, "o 2"]
    fixed_views: Bool[np.ndarray, "v"]
    fixed_points: Bool[np.ndarray, "p"]
    refine: tuple[Bool[np.ndarray, "_"], ...]
    pixel_scale: Float[np.ndarray, "v"] | None = None

    def __post_init__(self) -> None:
        num_views, num_points = len(self.camera_of_view), len(self.points)
        if self.cam_from_world.R.shape != (num_views, 3, 3):
            raise ValueError(f"{num_views} views need as many poses, got {self.cam_from_world.R.shape}")
        if len(self.view) and not (self.view.min() >= 0 and self.view.max() < num_views):
            raise ValueError(f"an observation names a view outside 0..{num_views - 1}")
        if len(self.point) and not (self.point.min() >= 0 and self.point.max() < num_points):
            raise ValueError(f"an observation names a point outside 0..{num_points - 1}")
        if [len(mask) for mask in self.refine] != [len(camera.params) for camera in self.cameras]:
            raise ValueError("refine needs one mask per camera, as long as its parameters")
        if self.pixel_scale is not None:
            if self.pixel_scale.shape != (num_views,):
                raise ValueError(f"{num_views} views need as many pixel scales, got {self.pixel_scale.shape}")
            if not np.all((self.pixel_scale > 0) & np.isfinite(self.pixel_scale)):
                raise ValueError("pixel scales must be positive and finite")

    @property
    def num_views(self) -> int:
        """Number of poses, fixed or free."""
        return len(self.camera_of_view)

    @property
    def scale_of_view(self) -> Float[np.ndarray, "v"]:
        """`pixel_scale`, with the ones that None stands for."""
        return np.ones(self.num_views) if self.pixel_scale is None else self.pixel_scale


@dataclass(frozen=True, eq=False)
class BundleJacobian:
    """Derivatives of residual k by the tangent of its pose, by its point and by its camera's parameters.

    by_camera is padded with zeros to the longest parameter vector of the problem.
    """

    by_pose: Float[np.ndarray, "o 2 6"]
    by_point: Float[np.ndarray, "o 2 3"]
    by_camera: Float[np.ndarray, "o 2 p"]


def reprojection_residuals(problem: BundleProblem) -> Float[np.ndarray, "o 2"]:
    """Reprojected minus observed pixels, divided by the view's scale; nan where a point is behind its camera."""
    in_cam = problem.cam_from_world[problem.view].apply(problem.points[problem.point])
    out = np.empty_like(problem.pixels)
    for rows, camera in _rows_by_camera(problem):
        out[rows] = image_from_cam(camera, in_cam[rows]) - problem.pixels[rows]
    return out / problem.scale_of_view[problem.view, None]


def reprojection_jacobian(problem: BundleProblem) -> tuple[Float[np.ndarray, "o 2"], BundleJacobian]:
    """Residuals and their derivatives at the current values, all divided by the view's scale."""
    pose, X, count = problem.cam_from_world[problem.view], problem.points[problem.point], len(problem.view)
    longest = max((len(camera.params) for camera in problem.cameras), default=0)
    residuals = np.empty((count, 2))
    by_pose, by_point = np.empty((count, 2, 6)), np.empty((count, 2, 3))
    by_camera = np.zeros((count, 2, longest))
    for rows, camera in _rows_by_camera(problem):
        J = image_from_world_jacobian(camera, pose[rows], X[rows])
        by_pose[rows], by_point[rows] = J.by_pose, J.by_point
        by_camera[rows, :, : len(camera.params)] = J.by_params
        residuals[rows] = J.pixels - problem.pixels[rows]
    scale = problem.scale_of_view[problem.view, None, None]
    return residuals / scale[:, 0], BundleJacobian(by_pose / scale, by_point / scale, by_camera / scale)


def updated(
    problem: BundleProblem,
    pose_tangent: Float[np.ndarray, "v 6"],
    point_step: Float[np.ndarray, "p 3"],
    camera_steps: tuple[Float[np.ndarray, "_"], ...],
) -> BundleProblem:
    """The problem with poses retracted, points moved and camera parameters changed by the given steps.

    Raises:
        ValueError: A step makes a focal length negative.
    """
    cameras = tuple(
        replace(camera, params=camera.params + step) for camera, step in zip(problem.cameras, camera_steps, strict=True)
    )
    return replace(
        problem,
        cameras=cameras,
        cam_from_world=problem.cam_from_world.retract(pose_tangent),
        points=problem.points + point_step,
    )


def _rows_by_camera(problem: BundleProblem) -> list[tuple[np.ndarray, Camera]]:
    """Observation indices of each camera that has any."""
    camera_of_row = problem.camera_of_view[problem.view]
    groups = [(np.flatnonzero(camera_of_row == c), camera) for c, camera in enumerate(problem.cameras)]
    return [(rows, camera) for rows, camera in groups if len(rows)]
