"""Ideal coordinates of many pixels of several cameras at once: `geometry.camera.plane_from_image`, compiled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fieldstone.geometry.camera import Camera
from fieldstone.solve.projection.projection_numba import (
    MAX_CAMERA_PARAMS,
    MAX_COEFFICIENTS,
    NUM_COEFFICIENTS,
    NUM_FOCAL,
    distort_numba,
)

MAX_STEPS = 50


def plane_from_images(
    cameras: Sequence[Camera], camera: Int[np.ndarray, "n"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Ideal coordinates on the plane z = 1 of pixel k of camera `camera[k]`.

    nan where the distortion has no inverse near the pixel (outside the lens model's range).
    """
    params = np.zeros((len(cameras), MAX_CAMERA_PARAMS))
    for c, one in enumerate(cameras):
        params[c, : len(one.params)] = one.params
    models = np.array([one.spec.colmap_id for one in cameras], dtype=np.int64)
    uv = np.empty((len(pixels), 2))
    _undistort(models, params, np.ascontiguousarray(camera, dtype=np.int64), np.ascontiguousarray(pixels), uv)
    return uv


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _undistort(models, params, camera, pixels, uv):
    """Newton's method on the distortion, pixel by pixel."""
    J_k = np.empty((2, MAX_COEFFICIENTS))
    for n in range(len(pixels)):
        p, model = params[camera[n]], models[camera[n]]
        c = NUM_FOCAL[model]
        u_d = (pixels[n, 0] - p[c]) / p[0]
        v_d = (pixels[n, 1] - p[c + 1]) / p[c - 1]
        u, v = u_d, v_d
        if NUM_COEFFICIENTS[model] > 0:
            for _ in range(MAX_STEPS):
                a, b, du_du, du_dv, dv_du, dv_dv = distort_numba(model, p[c + 2 :], u, v, J_k)
                det = du_du * dv_dv - du_dv * dv_du
                step_u = (dv_dv * (a - u_d) - du_dv * (b - v_d)) / det
                step_v = (du_du * (b - v_d) - dv_du * (a - u_d)) / det
                length = np.sqrt(step_u * step_u + step_v * step_v)
                if not np.isfinite(length):
                    break
                # A step longer than the field of view has left the basin of convergence: shorten it.
                shorter = 0.5 / length if length > 0.5 else 1.0
                u -= shorter * step_u
                v -= shorter * step_v
                if length < 1e-14:
                    break
            a, b, du_du, du_dv, dv_du, dv_dv = distort_numba(model, p[c + 2 :], u, v, J_k)
            inverse_exists = du_du * dv_dv > du_dv * dv_du
            if not (inverse_exists and (a - u_d) ** 2 + (b - v_d) ** 2 < 1e-18):
                u = v = np.nan
        uv[n, 0], uv[n, 1] = u, v
