"""How well the matches of a pair determine its fundamental matrix."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.epipolar import homogeneous

SMALLEST_NOISE = 0.3
"""Standard deviation of a match, in units of its pixel scale: no keypoints are better."""
CENTRE_SIGMA = 0.005
"""Of the principal point about the origin, in the unit of the coordinates."""
RADIAL_SIGMA = 0.02
"""Of the radial distortion k in x (1 + k |x|^2), with x in the unit of the coordinates."""
MAD_TO_SIGMA = 1.4826


def with_rank_two(F: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The nearest matrix of rank 2, of norm 1."""
    U, s, Vt = np.linalg.svd(F)
    F = (U[:, :2] * s[:2]) @ Vt[:2]
    return F / np.linalg.norm(F)


def fundamental_covariance(
    F: Float[np.ndarray, "3 3"],
    x1: Float[np.ndarray, "n 2"],
    x2: Float[np.ndarray, "n 2"],
    scales: tuple[float, float],
) -> Float[np.ndarray, "9 9"]:
    """Covariance of the nine entries of a fundamental matrix of rank 2 and norm 1, row by row.

    To first order the Sampson errors e = J dF + noise, with dF in the seven directions that keep rank and norm, give
    (J^T J)^-1. To the noise of the matches comes what F would change by if the principal points were not at the
    origin, and if the lenses distorted a little: errors that more matches do not average out.

    Args:
        x1, x2: Matches that agree with F, in coordinates with the principal point as origin.
        scales: How much of each photo's coordinates counts as one in the errors.

    Source:
        `csurka1997` for the first part.
    """
    h1, h2 = homogeneous(x1), homogeneous(x2)
    line2, line1 = h1 @ F.T, h2 @ F
    slope = np.sqrt(
        scales[1] ** 2 * np.sum(line2[:, :2] ** 2, axis=1) + scales[0] ** 2 * np.sum(line1[:, :2] ** 2, axis=1)
    )
    slope = np.maximum(slope, 1e-12 * max(scales))
    errors = np.sum(h2 * line2, axis=1) / slope
    tangent = directions(F)
    J = np.einsum("ni,kij,nj->nk", h2, tangent, h1) / slope[:, None]
    # Directions that the matches do not feel at all get a large variance, not an infinite one.
    values, vectors = np.linalg.eigh(J.T @ J)
    inverse = (vectors / np.maximum(values, 1e-12 * values[-1])) @ vectors.T
    noise = max(MAD_TO_SIGMA * float(np.median(np.abs(errors))), SMALLEST_NOISE)
    systematic = [
        shift / slope
        for x, line in ((x1, line1), (x2, line2))
        for shift in (
            CENTRE_SIGMA * line[:, 0],
            CENTRE_SIGMA * line[:, 1],
            RADIAL_SIGMA * np.sum(line[:, :2] * x, axis=1) * np.sum(x**2, axis=1),
        )
    ]
    moved = inverse @ J.T @ np.array(systematic).T
    basis = tangent.reshape(7, 9)
    return basis.T @ (noise**2 * inverse + moved @ moved.T) @ basis


def directions(F: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "7 3 3"]:
    """Orthonormal directions in which F keeps rank 2 and norm 1."""
    (u1, u2, u3), s, (v1, v2, v3) = (m.T if k == 0 else m for k, m in enumerate(np.linalg.svd(F)))
    along = (s[1] * np.outer(u1, v1) - s[0] * np.outer(u2, v2)) / np.hypot(s[0], s[1])
    pairs = ((u1, v2), (u2, v1), (u1, v3), (u2, v3), (u3, v1), (u3, v2))
    return np.array([along, *(np.outer(u, v) for u, v in pairs)])
