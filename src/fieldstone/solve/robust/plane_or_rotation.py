"""Whether the matches of two photos are explained without depth: by one plane, or by a rotation alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.solve.robust.consensus_models_numba import HOMOGRAPHY
from fieldstone.solve.robust.consensus_numba import consensus_numba
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.sampling import sampling_of

HOMOGRAPHY_TRIALS = 12
LOCAL_STEPS = 3
ROTATION_PASSES = 3


def transfer_errors(H: Float[np.ndarray, "3 3"], data: Float[np.ndarray, "8 c"]) -> Float[np.ndarray, "c"]:
    """Squared distance in pixels of the second photo between H x1 and x2; inf where H x1 lies behind the camera.

    Args:
        data: As `MatchData.as_transfer`.
    """
    x, y, z = H @ data[2:5]
    in_front = z > 0
    safe_z = np.where(in_front, z, 1.0)
    return np.where(in_front, ((x / safe_z - data[0]) ** 2 + (y / safe_z - data[1]) ** 2) * data[5] ** 2, np.inf)


def find_homography(
    data: Float[np.ndarray, "8 c"], options: RansacOptions, rng: np.random.Generator
) -> Float[np.ndarray, "3 3"] | None:
    """The homography that most of these matches agree with; None if none does.

    Few trials are enough: only a homography that holds for most of the matches matters here.

    Source:
        `hartley2004`, section 4.8.
    """
    count = data.shape[1]
    if count < 4:
        return None
    best = np.zeros(12)
    few = min(HOMOGRAPHY_TRIALS, options.max_trials)
    sampling = sampling_of(replace(options, min_trials=few, max_trials=few), rng, np.arange(count), LOCAL_STEPS)
    cost, _, _ = consensus_numba(HOMOGRAPHY, data, sampling, options.max_error_px**2, best)
    return best[:9].reshape(3, 3) if np.isfinite(cost) else None


def find_rotation(
    start: Float[np.ndarray, "3 3"], data: Float[np.ndarray, "8 c"], max_error_px: float, min_inliers: float
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, "c"]] | None:
    """The rotation x2 ~ R x1 near `start` and its inliers; None if it has fewer than `min_inliers`.

    Alternates between the matches that agree and the best rotation of their bearings.

    Source:
        `umeyama1991` (the best rotation of two sets of vectors).
    """
    R = start
    wide2 = (4.0 * max_error_px) ** 2
    bearings1 = data[2:5] / np.linalg.norm(data[2:5], axis=0)
    bearings2 = np.stack([data[0], data[1], np.ones(data.shape[1])])
    bearings2 /= np.linalg.norm(bearings2, axis=0)
    for k in range(ROTATION_PASSES):
        agree = transfer_errors(R, data) < (wide2 if k == 0 else max_error_px**2)
        if agree.sum() < min_inliers * (0.5 if k == 0 else 0.8):
            return None
        R = nearest_rotation(bearings2[:, agree] @ bearings1[:, agree].T)
    agree = transfer_errors(R, data) < max_error_px**2
    return (R, agree) if agree.sum() >= min_inliers else None


def motions_of_plane(H: Float[np.ndarray, "3 3"]) -> list[Rigid3]:
    """The two `cam2_from_cam1` with |t| = 1 (up to the sign of t) that move a plane as H does; none for a rotation.

    H = R + t n^T after division by its middle singular value; n and t follow from the eigenvectors of H^T H.

    Args:
        H: From the plane z = 1 of camera 1 to that of camera 2, of any scale, det(H) > 0.

    Source:
        `ma2004`, theorem 5.19.
    """
    H = H / np.linalg.svd(H)[1][1]
    H = H * np.sign(np.linalg.det(H))
    _, S, Vt = np.linalg.svd(H)
    s1, s3 = S[0] ** 2, S[2] ** 2
    if s1 - s3 < 1e-9:
        return []
    v1, v2, v3 = Vt
    a, b = np.sqrt(max(1.0 - s3, 0.0) / (s1 - s3)), np.sqrt(max(s1 - 1.0, 0.0) / (s1 - s3))
    motions = []
    for u in (a * v1 + b * v3, a * v1 - b * v3):
        n = np.cross(v2, u)
        U = np.stack([v2, u, n], axis=1)
        W = np.stack([H @ v2, H @ u, np.cross(H @ v2, H @ u)], axis=1)
        R = nearest_rotation(W @ U.T)
        t = (H - R) @ n
        motions.append(Rigid3(R, t / np.linalg.norm(t)))
    return motions
