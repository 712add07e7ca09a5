"""Rotation matrices: exponential map, logarithm, quaternions (for files), random draws, angles.

Every function takes any number of leading batch axes. Angles are radians.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SMALL_ANGLE = 1e-4


def skew(v: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Cross-product matrix: `skew(v) @ x == cross(v, x)`."""
    out = np.zeros((*v.shape[:-1], 3, 3), dtype=v.dtype)
    out[..., 0, 1] = -v[..., 2]
    out[..., 0, 2] = v[..., 1]
    out[..., 1, 0] = v[..., 2]
    out[..., 1, 2] = -v[..., 0]
    out[..., 2, 0] = -v[..., 1]
    out[..., 2, 1] = v[..., 0]
    return out


def exp(omega: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotation by the angle |omega| about the axis omega.

    R = I + sin(a)/a [omega] + (1 - cos(a))/a^2 [omega]^2, with the Taylor series of both factors near a = 0.

    Source:
        Rodrigues' formula; `hartley2004`, eq. A4.9.
    """
    angle2 = np.sum(omega * omega, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    omega_x = skew(omega)
    return np.eye(3) + a * omega_x + b * (omega_x @ omega_x)


def log(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Rotation vector omega with `exp(omega) == R` and |omega| <= pi; exact near 0 and near pi.

    Through the unit quaternion, whose vector part stays accurate where the antisymmetric part of R vanishes.
    """
    wxyz = to_wxyz(R)
    w, v = wxyz[..., :1], wxyz[..., 1:]
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, w)
    small = norm < SMALL_ANGLE
    factor = np.where(small, 2.0 + norm**2 / 3.0, angle / np.where(small, 1.0, norm))
    return factor * v


def right_jacobian(omega: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """J with exp(omega + d) = exp(omega) exp(J d) to first order.

    J = I - (1 - cos a)/a^2 [omega] + (a - sin a)/a^3 [omega]^2, with Taylor series near a = |omega| = 0.

    Source:
        `chirikjian2011`, section 10.6.
    """
    angle2 = np.sum(omega * omega, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < 1e-2
    safe = np.where(small, 1.0, angle)
    b = np.where(small, 0.5 - angle2 / 24.0 + angle2**2 / 720.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    c = np.where(small, 1.0 / 6.0 - angle2 / 120.0 + angle2**2 / 5040.0, (safe - np.sin(safe)) / safe**3)
    omega_x = skew(omega)
    return np.eye(3) - b * omega_x + c * (omega_x @ omega_x)


def from_wxyz(wxyz: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotation of a Hamilton quaternion (w, x, y, z); normalised first.

    Raises:
        ValueError: A quaternion is zero or not finite.
    """
    norm = np.linalg.norm(wxyz, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm) & (norm > 0)):
        raise ValueError("a quaternion is zero or not finite")
    w, x, y, z = np.moveaxis(wxyz / norm, -1, 0)
    out = np.empty((*w.shape, 3, 3))
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - w * z)
    out[..., 0, 2] = 2 * (x * z + w * y)
    out[..., 1, 0] = 2 * (x * y + w * z)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - w * x)
    out[..., 2, 0] = 2 * (x * z - w * y)
    out[..., 2, 1] = 2 * (y * z + w * x)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out


def to_wxyz(R: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0.

    The largest of the four squared components is the pivot, so the division never loses digits.

    Source:
        `shepperd1978`.
    """
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    four_squares = np.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22])
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    candidates = np.stack(
        [
            np.stack([four_squares[0], wx, wy, wz], axis=-1),
            np.stack([wx, four_squares[1], xy, xz], axis=-1),
            np.stack([wy, xy, four_squares[2], yz], axis=-1),
            np.stack([wz, xz, yz, four_squares[3]], axis=-1),
        ]
    )
    pivot = np.argmax(four_squares, axis=0)
    wxyz = np.take_along_axis(candidates, pivot[None, ..., None], axis=0)[0]
    wxyz = wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True)
    return np.where(wxyz[..., :1] < 0, -wxyz, wxyz)


def nearest_rotation(M: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """The rotation (det = +1) nearest to M in the Frobenius norm: U diag(1, 1, det(U V^T)) V^T.

    Source:
        `umeyama1991`, the lemma with A = M and B = I.
    """
    U, _, Vt = np.linalg.svd(M)
    d = np.ones((*M.shape[:-2], 3))
    d[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return (U * d[..., None, :]) @ Vt


def angle_between(R1: Float[np.ndarray, "*b 3 3"], R2: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b"]:
    """Angle of R1^T R2 in [0, pi], accurate to rounding at both ends."""
    return np.asarray(np.linalg.norm(log(np.swapaxes(R1, -1, -2) @ R2), axis=-1))


def random_rotation(count: int, rng: np.random.Generator) -> Float[np.ndarray, "count 3 3"]:
    """Rotations drawn uniformly over SO(3): normalised Gaussian quaternions."""
    return from_wxyz(rng.normal(size=(count, 4)))
