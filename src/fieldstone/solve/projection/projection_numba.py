"""Compiled projection of single points, all camera models in one function: `geometry.camera.image_from_cam`.

One function with a switch, rather than one per model, keeps compilation short; the switch costs nothing measurable.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.geometry.camera_models import CAMERA_MODELS

_BY_ID = {spec.colmap_id: spec for spec in CAMERA_MODELS.values()}
_IDS = range(max(_BY_ID) + 1)
NUM_FOCAL = tuple(_BY_ID[model].num_focal if model in _BY_ID else 0 for model in _IDS)
"""Of each model, by its number; 0 for numbers without a model."""
NUM_COEFFICIENTS = tuple(len(_BY_ID[model].coefficient_names) if model in _BY_ID else 0 for model in _IDS)
MAX_COEFFICIENTS = max(NUM_COEFFICIENTS)
MAX_CAMERA_PARAMS = 4 + MAX_COEFFICIENTS
"""Focal lengths, principal point and coefficients of the longest model."""
SMALL_RADIUS = 1e-8


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def distort_numba(model, k, u, v, J_k):
    """Distorted coordinates on the plane z = 1 and their derivatives; `J_k` (2, 8) receives those by coefficients.

    `k` (8,) holds the coefficients in the order of the model. Returns (u_d, v_d, du_du, du_dv, dv_du, dv_dv).
    """
    if model <= 1:
        return u, v, 1.0, 0.0, 0.0, 1.0
    r2 = u * u + v * v
    if model == 5:
        return _distort_fisheye(k, u, v, r2, J_k)
    top = 1.0 + r2 * (k[0] + (r2 * k[1] if model > 2 else 0.0))
    d_top = k[0] + (2.0 * r2 * k[1] if model > 2 else 0.0)
    factor, d_factor = top, d_top
    inv_bottom = 1.0
    if model == 6:
        r4 = r2 * r2
        inv_bottom = 1.0 / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        factor = (top + k[4] * r2 * r4) * inv_bottom
        d_bottom = k[5] + 2.0 * k[6] * r2 + 3.0 * k[7] * r4
        d_factor = (d_top + 3.0 * k[4] * r4 - factor * d_bottom) * inv_bottom
        for i in range(3):
            power = r2 if i == 0 else (r4 if i == 1 else r2 * r4)
            J_k[0, 5 + i] = -u * factor * power * inv_bottom
            J_k[1, 5 + i] = -v * factor * power * inv_bottom
        J_k[0, 4] = u * r2 * r4 * inv_bottom
        J_k[1, 4] = v * r2 * r4 * inv_bottom
    J_k[0, 0] = u * r2 * inv_bottom
    J_k[1, 0] = v * r2 * inv_bottom
    J_k[0, 1] = u * r2 * r2 * inv_bottom
    J_k[1, 1] = v * r2 * r2 * inv_bottom
    u_d, v_d = u * factor, v * factor
    du_du = factor + 2.0 * d_factor * u * u
    du_dv = 2.0 * d_factor * u * v
    dv_dv = factor + 2.0 * d_factor * v * v
    if model == 4 or model == 6:
        p1, p2 = k[2], k[3]
        uv2 = 2.0 * u * v
        J_k[0, 2] = uv2
        J_k[1, 2] = r2 + 2.0 * v * v
        J_k[0, 3] = r2 + 2.0 * u * u
        J_k[1, 3] = uv2
        u_d += p1 * uv2 + p2 * J_k[0, 3]
        v_d += p1 * J_k[1, 2] + p2 * uv2
        du_du += 2.0 * p1 * v + 6.0 * p2 * u
        du_dv += 2.0 * (p1 * u + p2 * v)
        dv_dv += 6.0 * p1 * v + 2.0 * p2 * u
    return u_d, v_d, du_du, du_dv, du_dv, dv_dv


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _distort_fisheye(k, u, v, r2, J_k):
    """Equidistant fisheye: `geometry.camera_models.fisheye` for one point."""
    r = np.sqrt(r2)
    theta = np.arctan(r)
    theta2 = theta * theta
    series = 1.0 + theta2 * (k[0] + theta2 * (k[1] + theta2 * (k[2] + theta2 * k[3])))
    d_series = 1.0 + theta2 * (3.0 * k[0] + theta2 * (5.0 * k[1] + theta2 * (7.0 * k[2] + 9.0 * theta2 * k[3])))
    theta_over_r, factor, d_factor = 1.0, 1.0, 0.0
    if r > SMALL_RADIUS:
        theta_over_r = theta / r
        factor = theta_over_r * series
        d_factor = (d_series / (1.0 + r2) - factor) / r2
    power = theta_over_r
    for i in range(4):
        power *= theta2
        J_k[0, i] = u * power
        J_k[1, i] = v * power
    return (
        u * factor,
        v * factor,
        factor + d_factor * u * u,
        d_factor * u * v,
        d_factor * u * v,
        factor + d_factor * v * v,
    )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def image_from_cam_numba(model, params, x, y, z, J_point, J_params, J_k):
    """Pixels of one point in the camera frame; fills J_point (2, 3) and J_params (2, 12); needs z > 0.

    `params` (12,) is padded with zeros; J_k (2, 8) is scratch space.
    """
    inv_z = 1.0 / z
    u = x * inv_z
    v = y * inv_z
    c = NUM_FOCAL[model]
    two_focal = c == 2
    fx = params[0]
    fy = params[c - 1]
    u_d, v_d, du_du, du_dv, dv_du, dv_dv = distort_numba(model, params[c + 2 :], u, v, J_k)
    J_point[0, 0] = fx * du_du * inv_z
    J_point[0, 1] = fx * du_dv * inv_z
    J_point[0, 2] = -(J_point[0, 0] * u + J_point[0, 1] * v)
    J_point[1, 0] = fy * dv_du * inv_z
    J_point[1, 1] = fy * dv_dv * inv_z
    J_point[1, 2] = -(J_point[1, 0] * u + J_point[1, 1] * v)
    J_params[0, 0] = u_d
    J_params[1, 0] = 0.0 if two_focal else v_d
    if two_focal:
        J_params[0, 1] = 0.0
        J_params[1, 1] = v_d
    J_params[0, c] = 1.0
    J_params[1, c] = 0.0
    J_params[0, c + 1] = 0.0
    J_params[1, c + 1] = 1.0
    for i in range(NUM_COEFFICIENTS[model]):
        J_params[0, c + 2 + i] = fx * J_k[0, i]
        J_params[1, c + 2 + i] = fy * J_k[1, i]
    return fx * u_d + params[c], fy * v_d + params[c + 1]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def robust_numba(loss, scale2, s):
    """(rho, weight) of a squared residual; loss 0 trivial, 1 Huber, 2 soft L1, 3 Cauchy: `robust.loss`."""
    if loss == 0:
        return s, 1.0
    q = s / scale2
    if loss == 1:
        if q <= 1.0:
            return s, 1.0
        root = np.sqrt(q)
        return scale2 * (2.0 * root - 1.0), 1.0 / root
    if loss == 2:
        root = np.sqrt(1.0 + q)
        return 2.0 * s / (1.0 + root), 1.0 / root
    return scale2 * np.log1p(q), 1.0 / (1.0 + q)
