"""Geometry of two photos from matches, some of them wrong: E or F, or a plane or a rotation that explains them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.epipolar import essential_from_pose, fundamental_from_essential
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.match_graph import TwoView
from fieldstone.solve.robust.consensus_models_numba import ESSENTIAL, FUNDAMENTAL, PARALLAX, refine_model_numba
from fieldstone.solve.robust.consensus_numba import consensus_numba
from fieldstone.solve.robust.epipolar_numba import epipolar_errors_numba
from fieldstone.solve.robust.essential_numba import choose_pose_numba, essential_from_state_numba
from fieldstone.solve.robust.match_data import MatchData, match_data
from fieldstone.solve.robust.plane_or_rotation import (
    find_homography,
    find_rotation,
    motions_of_plane,
    transfer_errors,
)
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.sampling import sampling_of, soft_scale

LOCAL_STEPS = 8
FINAL_STEPS, FINAL_TOLERANCE = 30, 1e-9
# Scale of the last, soft refinement: per noise of the inliers, and at most this fraction of the threshold.
SCALE_PER_SIGMA, SCALE_LIMIT = 2.0, 0.5
# A plane that holds this fraction of F's inliers may have decided F alone.
DOMINANT_PLANE = 0.5


@dataclass(frozen=True)
class TwoViewOptions:
    """When matches of two photos count as geometry, and of which kind."""

    ransac: RansacOptions = field(default_factory=lambda: RansacOptions(max_error_px=1.5, min_trials=30))
    """Threshold on the Sampson error in pixels, and when to stop."""
    min_inliers: int = 15
    """Pairs with fewer agreeing matches are degenerate."""
    focal_known: bool = True
    """Estimate E; otherwise F, with the cameras' focal lengths used for nothing but scale."""
    planar_ratio: float = 0.8
    """Planar, if one homography holds for this fraction of the inliers."""
    panoramic_ratio: float = 0.9
    """Panoramic, if a rotation alone holds for this fraction of the inliers."""


def estimate_two_view(
    camera1: Camera,
    camera2: Camera,
    pixels1: Float[np.ndarray, "m 2"],
    pixels2: Float[np.ndarray, "m 2"],
    options: TwoViewOptions,
    rng: np.random.Generator,
    *,
    quality: Float[np.ndarray, "m"] | None = None,
    pixel_scales: tuple[float, float] = (1.0, 1.0),
) -> TwoView:
    """Geometry of two photos from their matches, by locally optimised RANSAC.

    Errors are Sampson errors in pixels: ideal coordinates, with the size of a pixel on the ideal plane at each match.
    The last refinement uses the loss of Geman and McClure, at a scale that follows the inliers' own noise. Where E is
    estimated, inliers also lie in front of both cameras. Matrices of kind "uncalibrated", "planar" and "panoramic"
    are for pixels of the ideal (undistorted) photos. Matches that stay where they are come from copies of one photo,
    which tell nothing, whatever is said of their cameras: they are panoramic, without a turn.

    Args:
        quality: Higher is better; good matches are then sampled first (PROSAC).
        pixel_scales: How many pixels of each photo count as one in its errors, so that one threshold serves photos
            whose keypoints were found at different scales.

    Raises:
        ValueError: Different numbers of pixels.

    Source:
        `nister2004` (five points), `hartley2004` (seven points), `chum2003` (local optimisation), `torr2000`
        (score), `chum2005` (PROSAC), `chum2005b` (a dominant plane).
    """
    if len(pixels1) != len(pixels2):
        raise ValueError(f"matches need one pixel in each photo, got {len(pixels1)} and {len(pixels2)}")
    matches = match_data(camera1, camera2, pixels1, pixels2, rng, pixel_scales)
    if len(matches.rows) < max(options.min_inliers, 8):
        return degenerate(len(pixels1))
    ranked = None if quality is None else np.argsort(-quality[matches.rows], kind="stable")
    K1, K2 = camera1.calibration_matrix(), camera2.calibration_matrix()
    unmoved = np.linalg.norm(pixels2 - pixels1, axis=1) < options.ransac.max_error_px * max(pixel_scales)
    if options.focal_known and np.mean(unmoved) >= options.panoramic_ratio:
        return TwoView("panoramic", np.eye(3), Rigid3.identity(), unmoved)
    if options.focal_known:
        return _calibrated(matches, ranked, K1, K2, options, rng)
    return _uncalibrated(matches, ranked, K1, K2, options, rng)


def degenerate(num_matches: int) -> TwoView:
    """No geometry: no match agrees with anything."""
    return TwoView("degenerate", np.zeros((3, 3)), None, np.zeros(num_matches, dtype=bool))


def _calibrated(matches: MatchData, ranked, K1, K2, options: TwoViewOptions, rng: np.random.Generator) -> TwoView:
    """E and its pose; then whether a rotation or a plane explains as much."""
    data, max_error_px = matches.columns, options.ransac.max_error_px
    state = np.empty(12)
    if not np.isfinite(_consensus(ESSENTIAL, data, ranked, options.ransac, rng, state)):
        return degenerate(matches.num_matches)
    softness = _softness(_essential_errors(state, data), max_error_px)
    refine_model_numba(ESSENTIAL, state, data, max_error_px**2, softness, FINAL_TOLERANCE, FINAL_STEPS)
    on_lines = _essential_errors(state, data) < max_error_px**2
    inliers = on_lines.copy()
    choose_pose_numba(state, data, inliers)
    if on_lines.sum() < options.min_inliers:
        return degenerate(matches.num_matches)

    transfer = matches.as_transfer(on_lines)
    R = state[:9].reshape(3, 3)
    rotation = find_rotation(R, transfer, max_error_px, options.panoramic_ratio * transfer.shape[1])
    if rotation is not None:
        R, agree = rotation
        on_lines[np.flatnonzero(on_lines)[~agree]] = False
        return TwoView("panoramic", K2 @ R @ np.linalg.inv(K1), Rigid3(R, np.zeros(3)), matches.mask(on_lines))
    H = find_homography(transfer, options.ransac, rng)
    if H is not None and np.mean(transfer_errors(H, transfer) < max_error_px**2) < options.planar_ratio:
        H = None
    if H is not None:
        state, inliers = _best_motion_of_plane(H, state, inliers, data, softness, max_error_px**2)
    if inliers.sum() < options.min_inliers:
        return degenerate(matches.num_matches)
    cam2_from_cam1 = Rigid3(state[:9].reshape(3, 3).copy(), state[9:].copy())
    if H is not None:
        return TwoView("planar", K2 @ H @ np.linalg.inv(K1), cam2_from_cam1, matches.mask(inliers))
    return TwoView("calibrated", essential_from_pose(cam2_from_cam1), cam2_from_cam1, matches.mask(inliers))


def _best_motion_of_plane(
    H: Float[np.ndarray, "3 3"], state: Float[np.ndarray, "12"], inliers: Bool[np.ndarray, "n"], data, softness, limit
) -> tuple[Float[np.ndarray, "12"], Bool[np.ndarray, "n"]]:
    """Of the pose found and the two motions of the plane, the one with most inliers in front of both cameras.

    The two motions have different essential matrices that fit a plane equally well; only depths (and matches off the
    plane) tell them apart.
    """
    for motion in motions_of_plane(H):
        other = np.concatenate([motion.R.ravel(), motion.t])
        refine_model_numba(ESSENTIAL, other, data, limit, softness, FINAL_TOLERANCE, FINAL_STEPS)
        other_inliers = _essential_errors(other, data) < limit
        choose_pose_numba(other, data, other_inliers)
        if other_inliers.sum() > inliers.sum():
            state, inliers = other, other_inliers
    return state, inliers


def _essential_errors(state: Float[np.ndarray, "12"], data: Float[np.ndarray, "6 n"]) -> Float[np.ndarray, "n"]:
    """Squared Sampson errors in pixels under E = [t]_x R."""
    E, errors = np.empty(9), np.empty(data.shape[1])
    essential_from_state_numba(state, E)
    epipolar_errors_numba(E, data, errors)
    return errors


def _uncalibrated(matches: MatchData, ranked, K1, K2, options: TwoViewOptions, rng: np.random.Generator) -> TwoView:
    """F; with a dominant plane, F from the plane and its parallax where that is better."""
    data, threshold2 = matches.columns, options.ransac.max_error_px**2
    F, errors = np.zeros(12), np.empty(data.shape[1])
    cost = _consensus(FUNDAMENTAL, data, ranked, options.ransac, rng, F)
    if not np.isfinite(cost):
        return degenerate(matches.num_matches)
    epipolar_errors_numba(F, data, errors)
    H = find_homography(matches.as_transfer(errors < threshold2), options.ransac, rng)
    if H is not None:
        on_plane = transfer_errors(H, matches.as_transfer(np.ones(data.shape[1], dtype=bool))) < threshold2
        if on_plane.sum() >= DOMINANT_PLANE * np.sum(errors < threshold2):
            F = _with_parallax(H, on_plane, data, F, cost, options.ransac, rng)
            epipolar_errors_numba(F, data, errors)
    softness = _softness(errors, options.ransac.max_error_px)
    refine_model_numba(FUNDAMENTAL, F, data, threshold2, softness, FINAL_TOLERANCE, FINAL_STEPS)
    epipolar_errors_numba(F, data, errors)
    inliers = errors < threshold2
    if inliers.sum() < options.min_inliers:
        return degenerate(matches.num_matches)
    transfer = matches.as_transfer(inliers)
    H = find_homography(transfer, options.ransac, rng)
    if H is not None and np.mean(transfer_errors(H, transfer) < threshold2) >= options.planar_ratio:
        return TwoView("planar", K2 @ H @ np.linalg.inv(K1), None, matches.mask(inliers))
    matrix = fundamental_from_essential(F[:9].reshape(3, 3), K1, K2)
    return TwoView("uncalibrated", matrix / np.linalg.norm(matrix), None, matches.mask(inliers))


def _softness(errors: Float[np.ndarray, "n"], max_error_px: float) -> float:
    """1 / scale^2 of the last refinement."""
    return soft_scale(errors, max_error_px, SCALE_PER_SIGMA, SCALE_LIMIT * max_error_px) ** -2.0


def _with_parallax(
    H: Float[np.ndarray, "3 3"], on_plane: Bool[np.ndarray, "n"], data, F, cost: float, options: RansacOptions, rng
) -> Float[np.ndarray, "12"]:
    """F, or the F of a plane and two matches off it, whichever has the lower truncated cost.

    Source:
        `chum2005b`: samples that lie mostly on one plane give an F that holds for the plane and nothing else.
    """
    off_plane = np.flatnonzero(~on_plane)
    if len(off_plane) < 2:
        return F
    other = np.zeros(12)
    other[:9] = H.ravel()
    other_cost = _consensus(PARALLAX, data, None, options, rng, other, pool=off_plane)
    return other if other_cost < cost else F


def _consensus(kind: int, data, ranked, options: RansacOptions, rng, model, pool=None) -> float:
    """Truncated cost of the best model, which goes into `model`; inf if there is none."""
    progressive = ranked is not None
    if pool is None:
        pool = ranked if progressive else np.arange(data.shape[1])
    sampling = sampling_of(options, rng, pool, LOCAL_STEPS, progressive=progressive)
    cost, _, _ = consensus_numba(kind, data, sampling, options.max_error_px**2, model)
    return cost
