"""Epipolar geometry between two views: essential and fundamental matrices, poses, epipolar errors.

For a world point with bearings x in camera 1 and y in camera 2: y^T cam2_E_cam1 x = 0. For pixels in homogeneous
coordinates the same holds with the fundamental matrix image2_F_image1.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import skew


def homogeneous(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Append a column of ones."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)


def essential_from_pose(cam2_from_cam1: Rigid3) -> Float[np.ndarray, "3 3"]:
    """E = [t]_x R.

    Source:
        `hartley2004`, eq. 9.12.
    """
    return skew(cam2_from_cam1.t) @ cam2_from_cam1.R


def fundamental_from_essential(
    E: Float[np.ndarray, "3 3"], K1: Float[np.ndarray, "3 3"], K2: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """image2_F_image1 = K2^-T E K1^-1."""
    return np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)


def essential_from_fundamental(
    F: Float[np.ndarray, "3 3"], K1: Float[np.ndarray, "3 3"], K2: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """cam2_E_cam1 = K2^T F K1 with its singular values set to (1, 1, 0).

    Noise leaves K2^T F K1 outside the essential manifold; the nearest essential matrix has two equal singular
    values, and scale is free, so both are 1.

    Source:
        `hartley2004`, eq. 9.12 and section 11.7.3.
    """
    U, _, Vt = np.linalg.svd(K2.T @ F @ K1)
    return U @ np.diag([1.0, 1.0, 0.0]) @ Vt


def poses_from_essential(E: Float[np.ndarray, "3 3"]) -> list[Rigid3]:
    """The four `cam2_from_cam1` with [t]_x R = +-E, |t| = 1 and det(R) = +1.

    Exactly one of them puts the points in front of both cameras (see `triangulation.choose_by_cheirality`).

    Source:
        `hartley2004`, result 9.19.
    """
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses = []
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        # SVD leaves the signs of U and V free: R and -R solve the same equation, only one is a rotation.
        R_proper = R * np.sign(np.linalg.det(R))
        for t in (U[:, 2], -U[:, 2]):
            poses.append(Rigid3(R_proper, t.copy()))
    return poses


def epipolar_lines(F: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Lines (a, b, c) of the second image on which the matches of `pixels` lie, a^2 + b^2 = 1."""
    lines = homogeneous(pixels) @ F.T
    return lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)


def sampson_error(
    M: Float[np.ndarray, "3 3"], x1: Float[np.ndarray, "n 3"], x2: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """First-order squared distance of each correspondence to the epipolar constraint.

    With x' = M x1: error = (x2^T x')^2 / (x'_1^2 + x'_2^2 + (M^T x2)_1^2 + (M^T x2)_2^2).

    Args:
        M: Fundamental matrix for homogeneous pixels, or essential matrix for bearings of any scale.
        x1, x2: Correspondences; compared on the plane z = 1.

    Returns:
        Squared pixels for F, squared normalised units for E (multiply by focal^2). inf where z <= 0.

    Source:
        `hartley2004`, eq. 11.9.
    """
    in_front = (x1[:, 2] > 0) & (x2[:, 2] > 0)
    a = x1 / np.where(in_front, x1[:, 2], 1.0)[:, None]
    b = x2 / np.where(in_front, x2[:, 2], 1.0)[:, None]
    Ma, Mtb = a @ M.T, b @ M
    numerator = np.sum(b * Ma, axis=1) ** 2
    denominator = Ma[:, 0] ** 2 + Ma[:, 1] ** 2 + Mtb[:, 0] ** 2 + Mtb[:, 1] ** 2
    # A match at both epipoles satisfies every constraint: 0 / 0 counts as 0.
    error = np.where(numerator == 0, 0.0, numerator / np.maximum(denominator, 1e-300))
    return np.where(in_front, error, np.inf)


def symmetric_epipolar_distance(
    F: Float[np.ndarray, "3 3"], pixels1: Float[np.ndarray, "n 2"], pixels2: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Root mean square of the two distances in pixels of a match to its epipolar lines.

    Source:
        `hartley2004`, eq. 11.10.
    """
    a, b = homogeneous(pixels1), homogeneous(pixels2)
    numerator = np.sum(b * (a @ F.T), axis=1) ** 2
    line2, line1 = a @ F.T, b @ F
    return np.sqrt(
        0.5 * numerator * (1.0 / np.sum(line2[:, :2] ** 2, axis=1) + 1.0 / np.sum(line1[:, :2] ** 2, axis=1))
    )
