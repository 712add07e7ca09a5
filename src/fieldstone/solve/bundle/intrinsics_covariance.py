"""How well an adjusted bundle determines intrinsics, whatever its poses and points: by noise, and by what is seen.

The covariance of a bundle believes that the errors of all observations are independent. They are not: keypoints of a
point have the same bias in many photos, and what a lens model does not say is the same all over a photo. The second
covariance takes the errors as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.rotation import skew
from fieldstone.solve.bundle.adjustment import BundleOptions
from fieldstone.solve.bundle.covariance import inverse, reduced_normal_equations
from fieldstone.solve.bundle.layout import BundleLayout, free_view_of_camera
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_jacobian
from fieldstone.solve.robust.loss import RobustLoss

GAUGE_DAMPING = 1e-11
"""On the diagonal of the poses' part, whose seven free directions do not touch intrinsics."""


@dataclass(frozen=True, eq=False)
class IntrinsicsCovariance:
    """Covariances of the free intrinsics of all cameras; row k is parameter `param[k]` of camera `camera[k]`."""

    camera: Int[np.ndarray, "k"]
    param: Int[np.ndarray, "k"]
    by_noise: Float[np.ndarray, "k k"]
    """For independent errors of equal variance."""
    by_clusters: Float[np.ndarray, "k k"]
    """For errors that depend on each other within a photo and within a point, of the size that they have."""

    def standard_deviations(self) -> Float[np.ndarray, "k"]:
        """The larger of the two: few photos or points make the second one too small."""
        variance = np.maximum(np.diag(self.by_noise), np.diag(self.by_clusters))
        return np.sqrt(variance)


def intrinsics_covariance(
    problem: BundleProblem, options: BundleOptions, loss: RobustLoss, *, sigma_px: float = 1.0
) -> IntrinsicsCovariance:
    """Covariances at a minimum, poses and points eliminated; they depend on no gauge.

    With H the normal equations after the elimination and s_o the part of observation o in the gradient there,
    by_noise = sigma^2 H^-1 and by_clusters = H^-1 B H^-1; B sums s s^T over the sums s of photos and of points, less
    what is counted twice.

    Args:
        loss: That of the options, as a function.
        sigma_px: Of an observation, per axis.

    Raises:
        ValueError: The bundle is too large, or does not determine an intrinsic.

    Source:
        `cameron2011`, eq. 2.13.
    """
    layout, _, _, S = reduced_normal_equations(problem, options)
    column, camera, param = _columns_of_intrinsics(problem, layout)
    pose = np.concatenate([i * layout.block + np.arange(6) for i in range(layout.num_free_views)])
    A, C = S[np.ix_(pose, pose)], S[np.ix_(column, pose)]
    A[np.diag_indices_from(A)] *= 1.0 + GAUGE_DAMPING
    pose_by_intrinsic = -np.linalg.solve(A, C.T)
    H = S[np.ix_(column, column)] + C @ pose_by_intrinsic
    H_inv = inverse(0.5 * (H + H.T))
    scores = _scores(problem, loss, _poses_follow(problem, layout, pose_by_intrinsic), camera, param)
    B = _sum_over(scores, problem.view) + _sum_over(scores, problem.point) - _sum_over(scores, np.arange(len(scores)))
    return IntrinsicsCovariance(camera, param, sigma_px**2 * H_inv, H_inv @ B @ H_inv)


def _columns_of_intrinsics(
    problem: BundleProblem, layout: BundleLayout
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Column of the reduced system, camera and parameter of every free intrinsic that is observed."""
    view_of_camera, rows = free_view_of_camera(layout), []
    for c in range(len(problem.cameras)):
        if layout.per_view[c]:
            first = int(view_of_camera[c]) * layout.block + 6
        elif layout.shared_row[c] >= 0:
            first = layout.num_columns + int(layout.shared_row[c])
        else:
            continue
        rows += [(first + k, c, int(layout.refined[c, k])) for k in range(int(layout.num_refined[c]))]
    column, camera, param = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    return column, camera, param


def _poses_follow(
    problem: BundleProblem, layout: BundleLayout, pose_by_intrinsic: Float[np.ndarray, "p k"]
) -> Float[np.ndarray, "v 6 k"]:
    """How the right tangent of every view changes with the intrinsics, turned about the origin instead of the pivot."""
    out = np.zeros((problem.num_views, 6, pose_by_intrinsic.shape[1]))
    for i, v in enumerate(layout.view_order[: layout.num_free_views]):
        out[v] = pose_by_intrinsic[6 * i : 6 * i + 6]
    out[:, 3:] += skew(layout.pivot) @ out[:, :3]
    return out


def _scores(
    problem: BundleProblem,
    loss: RobustLoss,
    pose_by_intrinsic: Float[np.ndarray, "v 6 k"],
    camera: Int[np.ndarray, "k"],
    param: Int[np.ndarray, "k"],
) -> Float[np.ndarray, "o k"]:
    """J^T w r of every observation, J the derivative by the intrinsics when poses and points follow them."""
    residuals, J = reprojection_jacobian(problem)
    usable = np.all(np.isfinite(residuals), axis=1)
    residuals = np.where(usable[:, None], residuals, 0.0)
    weight = np.where(usable, loss(np.sum(residuals**2, axis=1))[1], 0.0)
    is_of_camera = problem.camera_of_view[problem.view][:, None, None] == camera
    by_intrinsic = np.nan_to_num(J.by_camera[:, :, param]) * is_of_camera
    by_intrinsic += np.nan_to_num(J.by_pose) @ pose_by_intrinsic[problem.view]
    by_point = np.nan_to_num(J.by_point)
    V = np.zeros((len(problem.points), 3, 3))
    g = np.zeros((len(problem.points), 3, len(param)))
    weighted = weight[:, None, None] * np.swapaxes(by_point, 1, 2)
    np.add.at(V, problem.point, weighted @ by_point)
    np.add.at(g, problem.point, weighted @ by_intrinsic)
    V[problem.fixed_points], g[problem.fixed_points] = np.eye(3), 0.0
    V += 1e-12 * np.trace(V, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    by_intrinsic -= by_point @ np.linalg.solve(V, g)[problem.point]
    return np.einsum("o,oij,oi->oj", weight, by_intrinsic, residuals)


def _sum_over(scores: Float[np.ndarray, "o k"], cluster: Int[np.ndarray, "o"]) -> Float[np.ndarray, "k k"]:
    """sum s s^T over the clusters' sums s, for a number of clusters that is not large."""
    _, cluster = np.unique(cluster, return_inverse=True)
    sums = np.zeros((int(cluster.max(initial=-1)) + 1, scores.shape[1]))
    np.add.at(sums, cluster, scores)
    return sums.T @ sums * len(sums) / max(len(sums) - 1, 1)
