"""Camera models: how each reads its parameters, and its distortion on the plane z = 1 with analytic Jacobians.

A new model is a row of CAMERA_MODELS here and a branch of `solve.projection.projection_numba.distort_numba`; the tests
find it in CAMERA_MODELS and ask `tests/geometry/test_camera.py` for parameters.

Every distortion takes ideal coordinates (n, 2) and its coefficients (k,), and returns the distorted coordinates
(n, 2), their derivative by the ideal coordinates (n, 2, 2) and by the coefficients (n, 2, k).

Source:
    The models and coefficient orders of COLMAP and OpenCV; the fisheye model is `kannala2006` with odd powers
    of the angle to the ninth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Distorted = tuple[
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, "n 2 2"],
    Float[np.ndarray, "n 2 k"],
]


def no_distortion(uv: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "0"]) -> Distorted:
    """Pinhole: coordinates pass unchanged."""
    n = len(uv)
    return uv.copy(), np.broadcast_to(np.eye(2), (n, 2, 2)).copy(), np.empty((n, 2, 0))


def radial(uv: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "k"]) -> Distorted:
    """Polynomial radial distortion: uv (1 + k1 r^2 + k2 r^4 + ...), any number of terms."""
    r2 = np.sum(uv * uv, axis=1)
    powers = r2[:, None] ** np.arange(1, len(coefficients) + 1)
    factor = 1.0 + powers @ coefficients
    exponents = np.arange(1, len(coefficients) + 1)
    d_factor = (r2[:, None] ** (exponents - 1)) @ (coefficients * exponents)
    J_uv = factor[:, None, None] * np.eye(2) + 2.0 * d_factor[:, None, None] * uv[:, :, None] * uv[:, None, :]
    return uv * factor[:, None], J_uv, uv[:, :, None] * powers[:, None, :]


def brown(uv: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "4"]) -> Distorted:
    """Two radial and two tangential terms, (k1, k2, p1, p2)."""
    k, p = coefficients[:2], coefficients[2:]
    distorted, J_uv, J_k = radial(uv, k)
    tangential, T_uv, T_p = _tangential(uv, p)
    return distorted + tangential, J_uv + T_uv, np.concatenate([J_k, T_p], axis=2)


def rational(uv: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "8"]) -> Distorted:
    """OpenCV's rational model, (k1, k2, p1, p2, k3, k4, k5, k6).

    uv (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + tangential.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    r2 = np.sum(uv * uv, axis=1)
    powers = r2[:, None] ** np.array([1, 2, 3])
    slopes = np.stack([np.ones_like(r2), 2 * r2, 3 * r2**2], axis=1)
    top, bottom = 1.0 + powers @ np.array([k1, k2, k3]), 1.0 + powers @ np.array([k4, k5, k6])
    factor = top / bottom
    d_factor = (slopes @ np.array([k1, k2, k3]) - factor * (slopes @ np.array([k4, k5, k6]))) / bottom
    J_uv = factor[:, None, None] * np.eye(2) + 2.0 * d_factor[:, None, None] * uv[:, :, None] * uv[:, None, :]
    tangential, T_uv, T_p = _tangential(uv, np.array([p1, p2]))
    J_top = uv[:, :, None] * (powers / bottom[:, None])[:, None, :]
    J_bottom = -uv[:, :, None] * (powers * (factor / bottom)[:, None])[:, None, :]
    J = np.concatenate([J_top[:, :, :2], T_p, J_top[:, :, 2:], J_bottom], axis=2)
    return uv * factor[:, None] + tangential, J_uv + T_uv, J


def fisheye(uv: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "4"]) -> Distorted:
    """Equidistant fisheye: the radius becomes theta (1 + k1 theta^2 + ... + k4 theta^8), theta = atan r."""
    r2 = np.sum(uv * uv, axis=1)
    r = np.sqrt(r2)
    small = r < 1e-8
    safe_r = np.where(small, 1.0, r)
    theta = np.arctan(r)
    powers = theta[:, None] ** np.array([2, 4, 6, 8])
    theta_d = theta * (1.0 + powers @ coefficients)
    d_theta_d = 1.0 + powers @ (coefficients * np.array([3, 5, 7, 9]))
    factor = np.where(small, 1.0, theta_d / safe_r)
    # d factor / d r^2, times 2, without the cancellation at r = 0.
    d_factor = np.where(small, 0.0, (d_theta_d / (1.0 + r2) - factor) / np.where(small, 1.0, r2))
    J_uv = factor[:, None, None] * np.eye(2) + d_factor[:, None, None] * uv[:, :, None] * uv[:, None, :]
    theta_over_r = np.where(small, 1.0, theta / safe_r)
    return uv * factor[:, None], J_uv, uv[:, :, None] * (powers * theta_over_r[:, None])[:, None, :]


def _tangential(uv: Float[np.ndarray, "n 2"], p: Float[np.ndarray, "2"]) -> Distorted:
    """(2 p1 u v + p2 (r^2 + 2 u^2), p1 (r^2 + 2 v^2) + 2 p2 u v) and its derivatives."""
    u, v = uv.T
    p1, p2 = p
    uv2, r2 = 2.0 * u * v, u * u + v * v
    value = np.stack([p1 * uv2 + p2 * (r2 + 2 * u * u), p1 * (r2 + 2 * v * v) + p2 * uv2], axis=1)
    cross = 2.0 * (p1 * u + p2 * v)
    J_uv = np.empty((len(uv), 2, 2))
    J_uv[:, 0, 0] = 2.0 * p1 * v + 6.0 * p2 * u
    J_uv[:, 0, 1] = J_uv[:, 1, 0] = cross
    J_uv[:, 1, 1] = 6.0 * p1 * v + 2.0 * p2 * u
    J_p = np.empty((len(uv), 2, 2))
    J_p[:, 0, 0] = J_p[:, 1, 1] = uv2
    J_p[:, 0, 1] = r2 + 2 * u * u
    J_p[:, 1, 0] = r2 + 2 * v * v
    return value, J_uv, J_p


@dataclass(frozen=True)
class CameraModel:
    """How the parameter vector of one model is read: focal length(s), principal point,"""

    name: str
    colmap_id: int
    num_focal: int
    """1: one focal length f for both axes; 2: fx, fy."""
    coefficient_names: tuple[str, ...]
    distort: Callable[[np.ndarray, np.ndarray], Distorted]

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names in the order of `Camera.params`."""
        focal = ("f",) if self.num_focal == 1 else ("fx", "fy")
        return (*focal, "cx", "cy", *self.coefficient_names)

    @property
    def num_params(self) -> int:
        """Length of `Camera.params`."""
        return self.num_focal + 2 + len(self.coefficient_names)


CAMERA_MODELS: dict[str, CameraModel] = {
    model.name: model
    for model in (
        CameraModel("SIMPLE_PINHOLE", 0, 1, (), no_distortion),
        CameraModel("PINHOLE", 1, 2, (), no_distortion),
        CameraModel("SIMPLE_RADIAL", 2, 1, ("k",), radial),
        CameraModel("RADIAL", 3, 1, ("k1", "k2"), radial),
        CameraModel("OPENCV", 4, 2, ("k1", "k2", "p1", "p2"), brown),
        CameraModel("OPENCV_FISHEYE", 5, 2, ("k1", "k2", "k3", "k4"), fisheye),
        CameraModel("FULL_OPENCV", 6, 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), rational),
    )
}
