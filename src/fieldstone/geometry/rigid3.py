"""Rigid transforms of space, named by their frames: `b_from_a`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry import rotation


@dataclass(frozen=True, eq=False)
class Rigid3:
    """x_b = R x_a + t, for one transform or a batch with any leading axes.

    A stored camera pose is `cam_from_world`; the camera's position is then `target_origin_in_source()`.
    """

    R: Float[np.ndarray, "*b 3 3"]
    t: Float[np.ndarray, "*b 3"]

    @staticmethod
    def identity() -> Rigid3:
        """The transform that leaves every point where it is."""
        return Rigid3(np.eye(3), np.zeros(3))

    @staticmethod
    def stack(transforms: list[Rigid3]) -> Rigid3:
        """A batch of transforms along a new first axis; an empty list gives a batch of length 0."""
        if not transforms:
            return Rigid3(np.empty((0, 3, 3)), np.empty((0, 3)))
        return Rigid3(np.stack([T.R for T in transforms]), np.stack([T.t for T in transforms]))

    def __getitem__(self, index) -> Rigid3:
        """One transform, or a sub-batch, of a batch."""
        return Rigid3(self.R[index], self.t[index])

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """`c_from_b @ b_from_a == c_from_a`."""
        return Rigid3(self.R @ other.R, self.apply(other.t))

    def apply(self, points_in_a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*m 3"]:
        """Points in b; batch axes broadcast (one transform takes (n, 3) points, a batch of n takes one each)."""
        return np.einsum("...ij,...j->...i", self.R, points_in_a) + self.t

    def inverse(self) -> Rigid3:
        """`a_from_b`."""
        R_inv = np.swapaxes(self.R, -1, -2)
        return Rigid3(R_inv, -np.einsum("...ij,...j->...i", R_inv, self.t))

    def retract(self, tangent: Float[np.ndarray, "*b 6"]) -> Rigid3:
        """Right update with the tangent (omega, v): R exp(omega), t + R v."""
        omega, v = tangent[..., :3], tangent[..., 3:]
        return Rigid3(self.R @ rotation.exp(omega), self.t + np.einsum("...ij,...j->...i", self.R, v))

    def target_origin_in_source(self) -> Float[np.ndarray, "*b 3"]:
        """Where b's origin lies in a: -R^T t. For `cam_from_world` this is the camera centre in the world."""
        return -np.einsum("...ji,...j->...i", self.R, self.t)

    def matrix(self) -> Float[np.ndarray, "*b 4 4"]:
        """Homogeneous 4x4 matrices."""
        out = np.zeros((*self.t.shape[:-1], 4, 4))
        out[..., :3, :3] = self.R
        out[..., :3, 3] = self.t
        out[..., 3, 3] = 1.0
        return out


def look_at(center: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Rigid3:
    """`cam_from_world` of a camera at `center` that looks at `target`, with `up` pointing up in its image.

    Raises:
        ValueError: The target is the centre, or straight up or down from it.
    """
    distance = np.linalg.norm(target - center)
    forward = (target - center) / (distance if distance > 0 else 1.0)
    right = np.cross(forward, up)
    length = np.linalg.norm(right)
    if not length > 1e-9 * np.linalg.norm(up):
        sight = f"from {center.tolist()} to {target.tolist()}"
        raise ValueError(f"a camera that looks {sight} has no upright position for up = {up.tolist()}")
    right = right / length
    R = np.stack([right, np.cross(forward, right), forward])
    return Rigid3(R, -R @ center)
