"""Camera pose from points with known positions, some of them wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.camera import Camera, plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.solve.robust.consensus_models_numba import POSE, refine_model_numba
from fieldstone.solve.robust.consensus_numba import consensus_numba
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.sampling import sampling_of, soft_scale

LOCAL_STEPS = 8
# Scale of the last, soft refinement: per noise of the inliers, and at most this multiple of the threshold. Wider than
# for epipolar errors, because two components per point leave outliers less room to agree by chance.
SCALE_PER_SIGMA, SCALE_LIMIT = 4.0, 2.0
FINAL_STEPS, FINAL_TOLERANCE = 30, 1e-9


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """A pose, the correspondences that agree with it, and the number of samples drawn."""

    cam_from_world: Rigid3
    inliers: Bool[np.ndarray, "n"]
    num_trials: int


def estimate_absolute_pose(
    camera: Camera,
    pixels: Float[np.ndarray, "n 2"],
    points_in_world: Float[np.ndarray, "n 3"],
    options: RansacOptions,
    rng: np.random.Generator,
) -> AbsolutePose | None:
    """Pose of a calibrated camera from correspondences with outliers: P3P in locally optimised RANSAC.

    The pose minimises the reprojection error in pixels of the real lens: an error on the ideal plane is turned into
    pixels by the derivative of the lens model at the observed pixel, exact to first order in the error. The last
    refinement uses the loss of Geman and McClure, at a scale that follows the inliers' own noise.

    Correspondences that are not finite, or whose pixel the lens model cannot have produced, count as outliers.

    Returns:
        None if no pose has at least four inliers.

    Raises:
        ValueError: Different numbers of pixels and points.

    Source:
        `ding2023` (P3P), `chum2003` (local optimisation), `torr2000` (score).
    """
    if len(pixels) != len(points_in_world):
        raise ValueError(f"absolute pose needs one point per pixel, got {len(pixels)} and {len(points_in_world)}")
    uv = plane_from_image(camera, pixels)
    usable = np.flatnonzero(np.isfinite(uv).all(axis=1) & np.isfinite(points_in_world).all(axis=1))
    if len(usable) < 4:
        return None
    rows = usable[rng.permutation(len(usable))]
    data = np.empty((8, len(rows)))
    data[:2] = uv[rows].T
    data[2:5] = points_in_world[rows].T
    data[5:] = plane_to_pixels(camera, uv[rows])
    threshold2 = options.max_error_px**2
    pose = np.empty(12)
    cost, num_inliers, trials = consensus_numba(
        POSE, data, sampling_of(options, rng, np.arange(len(rows)), LOCAL_STEPS), threshold2, pose
    )
    if not np.isfinite(cost) or num_inliers < 4:
        return None
    scale = soft_scale(
        squared_errors(pose, data), options.max_error_px, SCALE_PER_SIGMA, SCALE_LIMIT * options.max_error_px
    )
    refine_model_numba(POSE, pose, data, threshold2, 1.0 / scale**2, FINAL_TOLERANCE, FINAL_STEPS)
    inliers = np.zeros(len(pixels), dtype=bool)
    inliers[rows] = squared_errors(pose, data) < threshold2
    if inliers.sum() < 4:
        return None
    return AbsolutePose(Rigid3(pose[:9].reshape(3, 3).copy(), pose[9:].copy()), inliers, trials)


def plane_to_pixels(camera: Camera, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 n"]:
    """w11, w12, w22 of the upper triangular W with |W e| = |J e|, J the derivative of the pixel by the plane."""
    _, D_uv, _ = camera.spec.distort(uv, camera.coefficients)
    J = camera.focal[:, None] * D_uv
    w11 = np.hypot(J[:, 0, 0], J[:, 1, 0])
    w12 = (J[:, 0, 0] * J[:, 0, 1] + J[:, 1, 0] * J[:, 1, 1]) / w11
    w22 = np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]) / w11
    return np.stack([w11, w12, w22])


def squared_errors(pose: Float[np.ndarray, "12"], data: Float[np.ndarray, "8 n"]) -> Float[np.ndarray, "n"]:
    """Squared reprojection error in pixels of every correspondence; inf behind the camera."""
    x, y, z = pose[:9].reshape(3, 3) @ data[2:5] + pose[9:, None]
    in_front = z > 0
    safe_z = np.where(in_front, z, 1.0)
    du, dv = x / safe_z - data[0], y / safe_z - data[1]
    return np.where(in_front, (data[5] * du + data[6] * dv) ** 2 + (data[7] * dv) ** 2, np.inf)
