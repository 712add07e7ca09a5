"""One damped step of bundle adjustment, in dense numpy: the readable reference of the compiled solver.

The normal equations of cameras c (poses and intrinsics) and points p are

    [ U    W ] [dc]     [g_c]
    [ W^T  V ] [dp] = - [g_p],      V block-diagonal with 3x3 blocks,

each diagonal entry grown by the factor 1 + damping. Eliminating the points leaves the reduced camera system
(U - W V^-1 W^T) dc = -g_c + W V^-1 g_p, and then dp = -V^-1 (g_p + W^T dc).

Source:
    `triggs2000`, section 6.1; `hartley2004`, appendix 6.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.rotation import skew
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_jacobian
from fieldstone.solve.robust.loss import RobustLoss


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Gauss-Newton approximation of a bundle problem: columns of all poses, then cameras, then points.

    Columns of held parameters are there too, and zero.
    """

    H: Float[np.ndarray, "n n"]
    gradient: Float[np.ndarray, "n"]
    free: Bool[np.ndarray, "n"]
    cost: float
    num_camera_columns: int
    """Columns of poses and cameras; the others are points."""


@dataclass(frozen=True, eq=False)
class DampedStep:
    """Tangents (omega, v) about the pivot, changes of the padded camera parameters, and steps of the points."""

    pose_tangent: Float[np.ndarray, "v 6"]
    camera_step: Float[np.ndarray, "c k"]
    point_step: Float[np.ndarray, "p 3"]


def normal_equations(problem: BundleProblem, loss: RobustLoss, pivot: Float[np.ndarray, "3"]) -> NormalEquations:
    """Weighted normal equations, poses being turned about `pivot`: x = R exp(omega) (X - pivot) + R (pivot + v) + t.

    dx/domega = -R [X - pivot]_x and dx/dv = R: with the pivot at the origin, the tangent of `Rigid3.retract`.
    """
    residuals, J = reprojection_jacobian(problem)
    rho, weight = loss(np.sum(residuals**2, axis=1))
    root = np.sqrt(weight)[:, None]
    num_views, num_points, (num_obs, _, longest) = problem.num_views, len(problem.points), J.by_camera.shape
    of_camera = 6 * num_views + longest * np.arange(len(problem.cameras))
    of_point = of_camera[-1] + longest + 3 * np.arange(num_points)
    rows = np.zeros((num_obs, 2, of_camera[-1] + longest + 3 * num_points))
    by_omega = -J.by_point @ skew(problem.points[problem.point] - pivot)
    for k in range(num_obs):
        i, j = problem.view[k], problem.point[k]
        c = of_camera[problem.camera_of_view[i]]
        rows[k, :, 6 * i : 6 * i + 3] = by_omega[k]
        rows[k, :, 6 * i + 3 : 6 * i + 6] = J.by_point[k]
        rows[k, :, c : c + longest] = J.by_camera[k]
        rows[k, :, of_point[j] : of_point[j] + 3] = J.by_point[k]
    refine = np.zeros((len(problem.cameras), longest), dtype=bool)
    for row, mask in zip(refine, problem.refine, strict=True):
        row[: len(mask)] = mask
    free = np.concatenate([np.repeat(~problem.fixed_views, 6), refine.ravel(), np.repeat(~problem.fixed_points, 3)])
    A = (root[:, :, None] * rows * free).reshape(2 * num_obs, -1)
    gradient = A.T @ (root * residuals).ravel()
    return NormalEquations(A.T @ A, gradient, free, 0.5 * float(rho.sum()), int(of_camera[-1]) + longest)


def reduced_camera_system(
    equations: NormalEquations, damping: float
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m"]]:
    """(S, right-hand side) of the cameras with the points eliminated; identity rows for columns without entries."""
    m = equations.num_camera_columns
    H = _damped(equations.H, damping)
    V_inv = np.linalg.inv(H[m:, m:])
    W = H[:m, m:]
    return H[:m, :m] - W @ V_inv @ W.T, -equations.gradient[:m] + W @ V_inv @ equations.gradient[m:]


def damped_step(problem: BundleProblem, loss: RobustLoss, pivot: Float[np.ndarray, "3"], damping: float) -> DampedStep:
    """The step of one iteration through the Schur complement."""
    equations = normal_equations(problem, loss, pivot)
    m = equations.num_camera_columns
    S, rhs = reduced_camera_system(equations, damping)
    camera_part = np.linalg.solve(S, rhs)
    H = _damped(equations.H, damping)
    point_part = -np.linalg.solve(H[m:, m:], equations.gradient[m:] + H[m:, :m] @ camera_part)
    num_pose = 6 * problem.num_views
    return DampedStep(
        camera_part[:num_pose].reshape(-1, 6),
        camera_part[num_pose:].reshape(len(problem.cameras), -1),
        point_part.reshape(-1, 3),
    )


def _damped(H: Float[np.ndarray, "n n"], damping: float) -> Float[np.ndarray, "n n"]:
    """H + damping diag(H), with ones on the diagonal where it is zero."""
    diagonal = np.diag(H)
    return H + np.diag(np.where(diagonal > 0, damping * diagonal, 1.0))
