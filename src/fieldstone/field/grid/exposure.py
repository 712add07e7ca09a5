"""Exposure and white balance of every photo, learned with the grid field: one gain a channel.

A camera that chooses exposure and white balance for each photo shows one surface in different colours. A photo v then
shows exp(theta_v) C, channel by channel, of the colours C of the field. What all photos share stays with the field:
the mean of theta over the photos is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fieldstone.field.base.adam import adam_estimates
from fieldstone.geometry.rigid3 import Rigid3

BETAS = (0.9, 0.99)

SHRINK = 0.05
"""Pull towards gain 1, as a share of the learning rate: photos that say nothing keep what the camera gave."""

EPSILON = 1e-10

NEAREST = 2
"""A view that was not learned from takes the exposure of so many photos."""


class Exposure(NamedTuple):
    """theta, and the moments of Adam; float32 (3 v), photo by photo. Updated in place."""

    log_gain: np.ndarray
    first_moment: np.ndarray
    second_moment: np.ndarray


def unit_exposure(num_images: int) -> Exposure:
    """All photos alike."""
    return Exposure(*(np.zeros(3 * num_images, dtype=np.float32) for _ in Exposure._fields))


def gains_of(exposure: Exposure) -> Float[np.ndarray, "n"]:
    """exp(theta)."""
    return np.exp(exposure.log_gain)


def step_exposure(exposure: Exposure, gradients: Sequence[Float[np.ndarray, "n"]], count: int, rate: float) -> None:
    """One Adam step with the gradients of all chunks, added in their order, and a pull towards 1.

    Args:
        count: Number of this step, from 1.

    Source:
        `loshchilov2019`, algorithm 2: the pull stands beside the gradient.
    """
    gradient = np.zeros_like(exposure.log_gain)
    for part in gradients:
        gradient += part
    numerator, denominator = adam_estimates(
        exposure.first_moment, exposure.second_moment, gradient, count, betas=BETAS, epsilon=EPSILON
    )
    theta = exposure.log_gain
    theta -= np.float32(rate) * (numerator / denominator + np.float32(SHRINK) * theta)
    by_image = theta.reshape(-1, 3)
    by_image -= by_image.mean(axis=0, dtype=np.float64).astype(np.float32)


def gain_at(log_gain: Float[np.ndarray, "v 3"], cam_from_world: Rigid3, poses: Rigid3) -> Float[np.ndarray, "3"]:
    """The exposure that a camera at a pose would choose: that of the photos that see nearly the same.

    Photos are compared by where they stand, relative to the spread of all, and by where they look; the nearest
    `NEAREST` are weighted by the inverse of their distance.

    Args:
        log_gain: theta of the photos.
        poses: Of the photos, `cam_from_world`.
    """
    centers = poses.target_origin_in_source()
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0
    offset = np.linalg.norm(centers - cam_from_world.target_origin_in_source(), axis=1) / spread
    rotated = np.linalg.norm(poses.R[:, 2] - cam_from_world.R[2], axis=1)
    distance = np.hypot(offset, rotated)
    nearest = np.argsort(distance, kind="stable")[:NEAREST]
    weights = 1.0 / np.maximum(distance[nearest], 1e-3)
    return np.exp(weights @ log_gain[nearest] / weights.sum())
