"""Relative pose of two photos from matches, some of them wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.camera import Camera, plane_from_image
from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.match_graph import TwoView
from fieldstone.solve.consensus_numba import ESSENTIAL, consensus_numba, refine_model_numba
from fieldstone.solve.essential_numba import choose_pose_numba
from fieldstone.solve.ransac import RansacOptions
from fieldstone.solve.sampling import kernel_seed, soft_scale

LOCAL_STEPS = 8
FINAL_STEPS = 30


@dataclass(frozen=True)
class TwoViewOptions:
    """When matches of two photos count as geometry."""

    ransac: RansacOptions = field(default_factory=lambda: RansacOptions(max_error_px=1.5, min_trials=30))
    """Threshold on the Sampson error in pixels, and when to stop."""
    min_inliers: int = 15
    """Pairs with fewer agreeing matches are degenerate."""


def estimate_two_view(
    camera1: Camera,
    camera2: Camera,
    pixels1: Float[np.ndarray, "m 2"],
    pixels2: Float[np.ndarray, "m 2"],
    options: TwoViewOptions,
    rng: np.random.Generator,
    *,
    quality: Float[np.ndarray, "m"] | None = None,
) -> TwoView:
    """Geometry of two photos from their matches: five points in locally optimised RANSAC.

    Errors are Sampson errors in pixels: ideal coordinates, with the size of a pixel on the ideal plane at each match.
    The last refinement uses the loss of Geman and McClure, at a scale that follows the inliers' own noise. Inliers
    lie under the threshold and in front of both cameras.

    Args:
        quality: Higher is better; good matches are then sampled first (PROSAC).

    Raises:
        ValueError: Different numbers of pixels.

    Source:
        `nister2004` (five points), `chum2003` (local optimisation), `torr2000` (score), `chum2005` (PROSAC).
    """
    if len(pixels1) != len(pixels2):
        raise ValueError(f"matches need one pixel in each photo, got {len(pixels1)} and {len(pixels2)}")
    uv1, uv2 = plane_from_image(camera1, pixels1), plane_from_image(camera2, pixels2)
    usable = np.flatnonzero(np.isfinite(uv1).all(axis=1) & np.isfinite(uv2).all(axis=1))
    if len(usable) < max(options.min_inliers, 5):
        return degenerate(len(pixels1))
    rows = usable[rng.permutation(len(usable))]
    data = np.empty((6, len(rows)))
    data[:2], data[2:4] = uv1[rows].T, uv2[rows].T
    data[4], data[5] = pixel_size_squared(camera1, uv1[rows]), pixel_size_squared(camera2, uv2[rows])
    ranked = np.empty(0, np.int64) if quality is None else np.argsort(-quality[rows], kind="stable")
    ransac = options.ransac
    threshold2 = ransac.max_error_px**2
    state = np.empty(12)
    cost, _, _ = consensus_numba(
        ESSENTIAL, data, ranked, threshold2, ransac.confidence, ransac.min_trials, ransac.max_trials,
        LOCAL_STEPS, kernel_seed(rng), state,
    )  # fmt: skip
    if not np.isfinite(cost):
        return degenerate(len(pixels1))
    scale = soft_scale(sampson_errors(state, data), ransac.max_error_px)
    refine_model_numba(ESSENTIAL, state, data, threshold2, 1.0 / scale**2, 0.0, FINAL_STEPS)
    agree = np.empty(len(rows), np.bool_)
    num_inliers = choose_pose_numba(state, data, threshold2, agree)
    if num_inliers < options.min_inliers:
        return degenerate(len(pixels1))
    inliers = np.zeros(len(pixels1), dtype=bool)
    inliers[rows] = agree
    cam2_from_cam1 = Rigid3(state[:9].reshape(3, 3).copy(), state[9:].copy())
    return TwoView("calibrated", essential_from_pose(cam2_from_cam1), cam2_from_cam1, inliers)


def degenerate(num_matches: int) -> TwoView:
    """No geometry: no match agrees with anything."""
    return TwoView("degenerate", np.zeros((3, 3)), None, np.zeros(num_matches, dtype=bool))


def pixel_size_squared(camera: Camera, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Area of one pixel on the plane z = 1 at each coordinate: 1 / |det J|, J the derivative of the pixel."""
    _, D_uv, _ = camera.spec.distort(uv, camera.coefficients)
    det = D_uv[:, 0, 0] * D_uv[:, 1, 1] - D_uv[:, 0, 1] * D_uv[:, 1, 0]
    return 1.0 / (np.abs(det) * camera.focal.prod())


def sampson_errors(state: Float[np.ndarray, "12"], data: Float[np.ndarray, "6 n"]) -> Float[np.ndarray, "n"]:
    """Squared Sampson error in pixels of every match under E = [t]_x R."""
    E = essential_from_pose(Rigid3(state[:9].reshape(3, 3), state[9:]))
    x1, x2 = np.ones((3, data.shape[1])), np.ones((3, data.shape[1]))
    x1[:2], x2[:2] = data[:2], data[2:4]
    p, q = E @ x1, E.T @ x2
    C = np.sum(x2 * p, axis=0)
    return C**2 / (data[5] * (p[0] ** 2 + p[1] ** 2) + data[4] * (q[0] ** 2 + q[1] ** 2))
