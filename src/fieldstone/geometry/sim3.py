"""Similarity transforms and their least-squares fit to point pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False)
class Sim3:
    """x_b = scale R x_a + t."""

    scale: float
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]

    def __matmul__(self, other: Sim3) -> Sim3:
        """`c_from_b @ b_from_a == c_from_a`."""
        return Sim3(self.scale * other.scale, self.R @ other.R, self.apply(other.t))

    def apply(self, points_in_a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in b."""
        return self.scale * points_in_a @ self.R.T + self.t

    def inverse(self) -> Sim3:
        """`a_from_b`."""
        return Sim3(1.0 / self.scale, self.R.T, -(self.R.T @ self.t) / self.scale)

    def move_pose(self, cam_from_a: Rigid3) -> Rigid3:
        """`cam_from_b` up to the scale of the camera frame: the same view of the moved world.

        A camera at centre c in a stands at `apply(c)` in b; points in its frame are `scale` times as far away.
        """
        R = cam_from_a.R @ self.R.T
        centers_in_b = self.apply(cam_from_a.target_origin_in_source())
        return Rigid3(R, -np.einsum("...ij,...j->...i", R, centers_in_b))


def fit_sim3(
    points_in_a: Float[np.ndarray, "n 3"],
    points_in_b: Float[np.ndarray, "n 3"],
    *,
    with_scale: bool = True,
) -> Sim3:
    """The similarity `b_from_a` that minimises sum |x_b - (s R x_a + t)|^2, det(R) = +1.

    Collinear points leave a rotation about their line free: the result then is one of the minimisers.

    Raises:
        ValueError: Fewer than 2 points with scale, or all points of a the same.

    Source:
        `umeyama1991`, eqs. 34-42.
    """
    if len(points_in_a) < 2:
        raise ValueError(f"a similarity needs at least 2 point pairs, got {len(points_in_a)}")
    mean_a, mean_b = points_in_a.mean(axis=0), points_in_b.mean(axis=0)
    a, b = points_in_a - mean_a, points_in_b - mean_b
    variance_a = np.mean(np.sum(a * a, axis=1))
    if variance_a == 0:
        raise ValueError("a similarity needs points that differ: all points of the source are the same")
    U, d, Vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * sign) @ Vt
    scale = float(np.sum(d * sign) / variance_a) if with_scale else 1.0
    return Sim3(scale, R, mean_b - scale * R @ mean_a)
