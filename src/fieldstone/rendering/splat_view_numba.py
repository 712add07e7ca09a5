"""What a camera sees of Gaussian splats: the slow reference that exports are measured with."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.splats import Splats, splat_colors

DILATION = 0.3
"""Variance in pixels^2 that every splat gets in the image, so that none is smaller than a pixel."""

NEAR, MIN_ALPHA, MAX_ALPHA, EARLY_STOP_EPS = 0.05, 1.0 / 255.0, 0.99, 1e-4
REACH = 3.0
"""Splats end at this many standard deviations."""


def splat_view(
    splats: Splats, camera: Camera, cam_from_world: Rigid3, background: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w 3"]:
    """Splats blended front to back over a background, sRGB, for a camera without distortion.

    With J the derivative of the projection at the mean, a splat of covariance C covers the image with
    J R C R^T J^T + `DILATION` I.

    Source:
        `zwicker2001`, section 4; `kerbl2023`, section 4 and the constants of its program.
    """
    in_cam = cam_from_world.apply(splats.means)
    x, y, z = in_cam.T
    ahead = np.flatnonzero(z > NEAR)
    order = ahead[np.argsort(z[ahead], kind="stable")]
    x, y, z = x[order], y[order], z[order]
    fx, fy = camera.focal
    zero = np.zeros_like(z)
    J = np.stack([np.stack([fx / z, zero, -fx * x / z**2], 1), np.stack([zero, fy / z, -fy * y / z**2], 1)], 1)
    M = J @ cam_from_world.R @ (splats.axes[order] * splats.scales[order, None, :])
    covariance = M @ np.swapaxes(M, 1, 2) + DILATION * np.eye(2)
    pixels = camera.principal_point + np.stack([fx * x / z, fy * y / z], axis=1)
    colors = splat_colors(splats, cam_from_world.target_origin_in_source())[order]
    out = np.zeros((camera.height, camera.width, 3))
    transmittance = np.ones((camera.height, camera.width))
    reach = REACH * np.sqrt(np.stack([covariance[:, 0, 0], covariance[:, 1, 1]], axis=1))
    _blend(pixels, reach, np.linalg.inv(covariance), splats.opacities[order], colors, out, transmittance)
    return out + transmittance[..., None] * background


@njit(cache=True, nogil=True)
@no_type_check
def _blend(pixels, reach, inverse, opacities, colors, out, transmittance):
    """Add splats, nearest first. pixels, reach: (n, 2). inverse: (n, 2, 2). out: (h, w, 3). light: (h, w)."""
    height, width = transmittance.shape
    for n in range(pixels.shape[0]):
        u, v = pixels[n, 0], pixels[n, 1]
        if not np.isfinite(u + v + reach[n, 0] + reach[n, 1]):
            continue
        x0, x1 = int(max(np.ceil(u - reach[n, 0] - 0.5), 0.0)), int(min(np.floor(u + reach[n, 0] - 0.5), width - 1.0))
        y0, y1 = int(max(np.ceil(v - reach[n, 1] - 0.5), 0.0)), int(min(np.floor(v + reach[n, 1] - 0.5), height - 1.0))
        a, b, c = inverse[n, 0, 0], inverse[n, 0, 1], inverse[n, 1, 1]
        for j in range(y0, y1 + 1):
            for i in range(x0, x1 + 1):
                before = transmittance[j, i]
                if before < EARLY_STOP_EPS:
                    continue
                du, dv = i + 0.5 - u, j + 0.5 - v
                alpha = opacities[n] * np.exp(-0.5 * (a * du * du + 2.0 * b * du * dv + c * dv * dv))
                if alpha < MIN_ALPHA:
                    continue
                alpha = min(alpha, MAX_ALPHA)
                for k in range(3):
                    out[j, i, k] += before * alpha * colors[n, k]
                transmittance[j, i] = before * (1.0 - alpha)
