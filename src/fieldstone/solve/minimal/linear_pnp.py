"""Linear PnP: a camera pose from 6 or more points by the direct linear transform, and its RANSAC estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.camera import Camera, image_from_plane, plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.solve.minimal.eight_point import homogeneous_last, normalized

SAMPLE_SIZE = 6


def pnp_linear(
    uv: Float[np.ndarray, "*b n 2"], points_in_world: Float[np.ndarray, "*b n 3"]
) -> Float[np.ndarray, "*b 3 4"]:
    """cam_from_world as [R | t] from n >= 6 points seen at `uv` on the plane z = 1; any number of batch axes.

    Two equations a point (12 for 6 points) give P = s [R | t] up to a scale: the null vector of the rows
    (X, 0, -u X) and (0, X, -v X), with the points normalised first. The sign of s is that of det(P_3x3); the nearest
    rotation cleans R up, and the mean singular value is |s|.

    Points on a plane or on a line leave P undetermined: the result is then nan.

    Raises:
        ValueError: Fewer than 6 points.

    Source:
        `hartley2004`, algorithm 7.1 and section 7.1.1.
    """
    if uv.shape[-2] < SAMPLE_SIZE:
        raise ValueError(f"linear PnP needs {SAMPLE_SIZE} points, got {uv.shape[-2]}")
    local, T = normalized(points_in_world)
    X = homogeneous_last(local)
    zero = np.zeros_like(X)
    A = np.concatenate(
        [
            np.concatenate([X, zero, -uv[..., :1] * X], axis=-1),
            np.concatenate([zero, X, -uv[..., 1:] * X], axis=-1),
        ],
        axis=-2,
    )
    # The triangular factor has the same null vector and is only 12 x 12.
    _, d, Vt = np.linalg.svd(np.linalg.qr(A, mode="r"))
    P = Vt[..., -1, :].reshape(*A.shape[:-2], 3, 4) @ T
    sign = np.sign(np.linalg.det(P[..., :3]))
    P = P * sign[..., None, None]
    scale = np.linalg.svd(P[..., :3], compute_uv=False).mean(axis=-1)
    determined = (d[..., -2] > 1e-9 * d[..., 0]) & (scale > 0)
    t = P[..., 3:] / np.where(scale > 0, scale, 1.0)[..., None, None]
    R_t = np.concatenate([nearest_rotation(P[..., :3]), t], axis=-1)
    return np.where(determined[..., None, None], R_t, np.nan)


@dataclass(frozen=True, eq=False)
class PnpEstimator:
    """RANSAC over poses: samples of 6 points, reprojection error in pixels of the true camera model."""

    camera: Camera
    pixels: Float[np.ndarray, "n 2"]
    points_in_world: Float[np.ndarray, "n 3"]
    sample_size: int = SAMPLE_SIZE

    @property
    def num_data(self) -> int:
        """Number of correspondences."""
        return len(self.pixels)

    def fit_minimal(self, samples: Int[np.ndarray, "k s"]) -> Float[np.ndarray, "k 3 4"]:
        """One pose per sample; nan where the sample is degenerate."""
        return pnp_linear(plane_from_image(self.camera, self.pixels)[samples], self.points_in_world[samples])

    def squared_errors(self, models: Float[np.ndarray, "m 3 4"]) -> Float[np.ndarray, "m n"]:
        """Squared reprojection errors; inf behind the camera."""
        in_cam = np.einsum("mij,nj->mni", models[..., :3], self.points_in_world) + models[:, None, :, 3]
        z = np.where(in_cam[..., 2:] > 0, in_cam[..., 2:], np.nan)
        uv = (in_cam[..., :2] / z).reshape(-1, 2)
        reprojected = image_from_plane(self.camera, uv).reshape(*in_cam.shape[:2], 2)
        return np.nan_to_num(np.sum((reprojected - self.pixels) ** 2, axis=2), nan=np.inf)

    def refit(self, inliers: Int[np.ndarray, "i"]) -> Float[np.ndarray, "1 3 4"]:
        """The pose of all inliers."""
        return pnp_linear(plane_from_image(self.camera, self.pixels[inliers]), self.points_in_world[inliers])[None]


def pose_from_matrix(matrix: Float[np.ndarray, "3 4"]) -> Rigid3:
    """[R | t] as a transform."""
    return Rigid3(matrix[:, :3], matrix[:, 3])
