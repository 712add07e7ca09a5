"""What the matches of two photos say of a finished model when they are asked alone.

The geometry that a pair's matches agree on is found again without poses and without a focal length, so nothing that
mapping believed is part of it. What the model makes of the same matches is then held against it: how many it explains,
how much larger their errors are, and which way the pair would turn its cameras, and change their focal lengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp, skew
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.solve.robust.match_data import match_data
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view

SIGMA_PER_MAD = 1.4826
"""Of normal errors: standard deviation over median of the absolute values."""
SMALLEST_SIGMA_PX = 0.05
"""Errors of matches are not believed to be smaller."""
MAX_STEPS, SMALLEST_STEP, SMALLEST_GAIN = 12, 1e-7, 1e-4
MAX_MATCHES = 400
"""Of a pair: a sample of so many tells as much of the model as all of them."""


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """One pair of registered photos. Errors are Sampson errors in pixels of the detector."""

    pair: ImagePair
    matches: int
    """That agree with one geometry of uncalibrated photos."""
    kept: float
    """Share of them that the model explains: near its epipolar lines, and in front of both cameras."""
    free_px: float
    """Robust standard deviation of their errors under their own geometry."""
    model_px: float
    """And under that of the model."""
    rotation: float
    """Angle between the relative rotation that they prefer, with the cameras of the model, and that of the model."""
    rotation_sd: float
    """Standard deviation of the preferred one; both in radians."""
    focal_information: Float[np.ndarray, "2 2"]
    """Of the logarithms of both focal lengths, whatever the relative pose."""
    focal_score: Float[np.ndarray, "2"]
    """Gradient of half the squared error over its variance: where it is not 0, other focal lengths fit better."""

    @property
    def tension(self) -> float:
        """How many times larger errors are under the model."""
        return self.model_px / self.free_px


def evidence_of_pairs(
    model: Reconstruction,
    graph: MatchGraph,
    pairs: Sequence[ImagePair],
    options: TwoViewOptions,
    seed: int,
    threads: int,
) -> list[PairEvidence]:
    """Evidence of those pairs of registered photos that have a geometry, in their order."""
    scale = graph.scale_of_image

    def of(pair: ImagePair) -> PairEvidence | None:
        scales = float(scale[pair[0]]), float(scale[pair[1]])
        return evidence_of_pair(model, graph, pair, scales, options, np.random.default_rng([seed, *pair]))

    with ThreadPoolExecutor(threads) as pool:
        return [found for found in pool.map(of, pairs) if found is not None]


def evidence_of_pair(
    model: Reconstruction,
    graph: MatchGraph,
    pair: ImagePair,
    pixel_scales: tuple[float, float],
    options: TwoViewOptions,
    rng: np.random.Generator,
) -> PairEvidence | None:
    """Evidence of one pair; None where its matches agree on nothing."""
    camera1, camera2 = (model.camera_of(k) for k in pair)
    rows = graph.matches[pair]
    if len(rows) > MAX_MATCHES:
        rows = rows[rng.choice(len(rows), MAX_MATCHES, replace=False)]
    pixels1, pixels2 = graph.matched_pixels(pair, rows)
    own = estimate_two_view(
        camera1, camera2, pixels1, pixels2, replace(options, focal_known=False), rng, pixel_scales=pixel_scales
    )
    if own.inliers.sum() < options.min_inliers:
        return None
    columns = match_data(camera1, camera2, pixels1[own.inliers], pixels2[own.inliers], rng, pixel_scales).columns
    columns = columns[:, np.isfinite(columns).all(axis=0)]  # where a lens model turns back, a pixel has no size
    cam2_from_cam1 = model.pose_of(pair[1]) @ model.pose_of(pair[0]).inverse()
    distance = float(np.linalg.norm(cam2_from_cam1.t))
    if columns.shape[1] < options.min_inliers or distance == 0.0:
        return None
    start = Rigid3(cam2_from_cam1.R, cam2_from_cam1.t / distance)
    by_model = sampson_px(essential_from_pose(start), columns)
    limit = 2.0 * options.ransac.max_error_px
    kept = (np.abs(by_model) < limit) & in_front(start, columns)
    sigma = _robust_sigma(by_model[np.abs(by_model) < limit])
    preferred, errors, J = preferred_pose(start, columns, sigma)
    free_px = _robust_sigma(errors, 5)
    if own.kind == "uncalibrated":
        matrix = camera2.calibration_matrix().T @ own.matrix @ camera1.calibration_matrix()
        free_px = min(free_px, _robust_sigma(sampson_px(matrix, columns), 7))
    information, gradient = normal_equations(J, errors, sigma)
    A, B, C = information[:5, :5], information[:5, 5:], information[5:, 5:]
    covariance = np.linalg.pinv(A, hermitian=True)
    return PairEvidence(
        pair,
        columns.shape[1],
        float(kept.mean()),
        free_px,
        _robust_sigma(by_model),
        float(angle_between(preferred.R[None], start.R[None])[0]),
        float(np.sqrt(np.trace(covariance[:3, :3]))),
        C - B.T @ covariance @ B,
        gradient[5:] - B.T @ covariance @ gradient[:5],
    )


def preferred_pose(
    start: Rigid3, columns: Float[np.ndarray, "6 n"], sigma_px: float
) -> tuple[Rigid3, Float[np.ndarray, "n"], Float[np.ndarray, "n 7"]]:
    """The relative pose near `start` with the smallest errors, those errors, and their Jacobian there.

    Gauss-Newton steps on the Sampson error with weights of Cauchy's loss, halved until the loss falls.
    """
    pose, errors = start, sampson_px(essential_from_pose(start), columns)
    loss = _loss(errors, sigma_px)
    for _ in range(MAX_STEPS):
        J = jacobian(pose, columns)
        information, gradient = normal_equations(J[:, :5], errors, sigma_px)
        step = -np.linalg.lstsq(information, gradient, rcond=1e-12)[0]
        for _ in range(6):
            trial = moved(pose, step)
            trial_errors = sampson_px(essential_from_pose(trial), columns)
            trial_loss = _loss(trial_errors, sigma_px)
            if trial_loss < loss:
                break
            step = 0.5 * step
        else:
            break
        gain = loss - trial_loss
        pose, errors, loss = trial, trial_errors, trial_loss
        if gain < SMALLEST_GAIN * loss or np.abs(step).max() < SMALLEST_STEP:
            break
    return pose, errors, jacobian(pose, columns)


def sampson_px(matrix: Float[np.ndarray, "3 3"], columns: Float[np.ndarray, "6 n"]) -> Float[np.ndarray, "n"]:
    """Signed Sampson errors y^T M x / sqrt(v2 |(M x)_12|^2 + v1 |(M^T y)_12|^2); columns as in `match_data`.

    Source:
        `hartley2004`, eq. 11.9.
    """
    x, y = _planes(columns)
    Mx, Mty = x @ matrix.T, y @ matrix
    return np.einsum("ni,ni->n", y, Mx) / _denominator(Mx, Mty, columns)


def jacobian(pose: Rigid3, columns: Float[np.ndarray, "6 n"]) -> Float[np.ndarray, "n 7"]:
    """Derivatives of the errors: rotation (left tangent), translation in two directions across it, log f1, log f2.

    Focal lengths f e^l stand for E diag(e^-l1, e^-l1, 1) on the planes as they are, and so with l2 from the left. The
    derivative of the denominator has a part: without it noise in the photos alone would ask for longer focal lengths.
    """
    x, y = _planes(columns)
    E, t_x, flat = essential_from_pose(pose), skew(pose.t), np.diag([1.0, 1.0, 0.0])
    by_rotation = [t_x @ skew(axis) @ pose.R for axis in np.eye(3)]
    by_translation = [skew(direction) @ pose.R for direction in across(pose.t).T]
    dE = np.stack([*by_rotation, *by_translation, -E @ flat, -flat @ E])
    Ex, Ety = x @ E.T, y @ E
    C, D = np.einsum("ni,ni->n", y, Ex), _denominator(Ex, Ety, columns)
    p = (x @ dE[:, :2].reshape(14, 3).T).reshape(-1, 7, 2)  # first two rows of dE x
    q = (y @ dE.transpose(1, 0, 2)[:, :, :2].reshape(3, 14)).reshape(-1, 7, 2)
    Ex2, Ety2 = columns[5, :, None] * Ex[:, :2], columns[4, :, None] * Ety[:, :2]
    half = np.einsum("nki,ni->nk", p, Ex2) + np.einsum("nki,ni->nk", q, Ety2)
    dC = (y[:, :, None] * x[:, None, :]).reshape(-1, 9) @ dE.reshape(7, 9).T
    return dC / D[:, None] - (C / D)[:, None] * (half / D[:, None] ** 2)  # D^3 may underflow at an epipole


def moved(pose: Rigid3, step: Float[np.ndarray, "5"]) -> Rigid3:
    """The pose after a step of `jacobian`, with |t| = 1."""
    t = pose.t + across(pose.t) @ step[3:]
    return Rigid3(exp(step[:3]) @ pose.R, t / np.linalg.norm(t))


def across(t: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Two unit vectors that are orthogonal to a unit vector and to each other."""
    first = np.cross(t, np.eye(3)[np.argmin(np.abs(t))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(t, first)], axis=1)


def in_front(cam2_from_cam1: Rigid3, columns: Float[np.ndarray, "6 n"]) -> Bool[np.ndarray, "n"]:
    """Matches whose rays come nearest to each other before both cameras, or run parallel."""
    x, y = _planes(columns)
    a, b = x @ cam2_from_cam1.R.T, y
    a, b = a / np.linalg.norm(a, axis=1, keepdims=True), b / np.linalg.norm(b, axis=1, keepdims=True)
    cosine, at, bt = np.sum(a * b, axis=1), a @ cam2_from_cam1.t, b @ cam2_from_cam1.t
    # Depths times 1 - cosine^2; rays that are parallel within a pixel or so have no sign.
    pixel = np.sqrt(np.maximum(columns[4], columns[5]))
    return (cosine * bt - at > -pixel) & (bt - cosine * at > -pixel)


def normal_equations(
    J: Float[np.ndarray, "n k"], errors: Float[np.ndarray, "n"], sigma_px: float
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k"]]:
    """J^T W J and J^T W r over the variance of the errors, with the weights of Cauchy's loss."""
    weight = 1.0 / (1.0 + (errors / (2.0 * sigma_px)) ** 2)
    weighted = J * (weight / sigma_px**2)[:, None]
    return J.T @ weighted, weighted.T @ errors


def _loss(errors: Float[np.ndarray, "n"], sigma_px: float) -> float:
    return float(np.log1p((errors / (2.0 * sigma_px)) ** 2).sum())


def _robust_sigma(errors: Float[np.ndarray, "n"], parameters: int = 0) -> float:
    """Standard deviation of most errors, when so many parameters were fitted to them."""
    if len(errors) <= parameters:
        return SMALLEST_SIGMA_PX
    freedom = np.sqrt(len(errors) / (len(errors) - parameters))
    return max(SIGMA_PER_MAD * freedom * float(np.median(np.abs(errors))), SMALLEST_SIGMA_PX)


def _planes(columns: Float[np.ndarray, "6 n"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Both ends of the matches on the planes z = 1."""
    one = np.ones((columns.shape[1], 1))
    return np.concatenate([columns[:2].T, one], axis=1), np.concatenate([columns[2:4].T, one], axis=1)


def _denominator(
    Mx: Float[np.ndarray, "n 3"], Mty: Float[np.ndarray, "n 3"], columns: Float[np.ndarray, "6 n"]
) -> Float[np.ndarray, "n"]:
    squared = columns[5] * (Mx[:, 0] ** 2 + Mx[:, 1] ** 2) + columns[4] * (Mty[:, 0] ** 2 + Mty[:, 1] ** 2)
    return np.sqrt(np.maximum(squared, 1e-300))
