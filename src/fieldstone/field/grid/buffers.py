"""Arrays that the kernels work in: rays, samples along them, and what the way back needs. All are flat."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fieldstone.field.grid.decoder import HIDDEN, Decoder
from fieldstone.field.grid.march_numba import Samples


class RayBatch(NamedTuple):
    """Rays of one chunk."""

    origins: np.ndarray
    directions: np.ndarray
    """As marched, see `space.marched_rays`."""
    views: np.ndarray
    """Directions as the camera looks, for the decoder."""
    target: np.ndarray
    """Colours of the pixels."""
    background: np.ndarray
    image: np.ndarray
    """Which photo shows the ray."""
    gain: np.ndarray
    """Of that photo: how bright it shows each channel."""
    depth_row: np.ndarray
    """Row of `SparseDepths` on the ray, -1 without one."""
    free_distance: np.ndarray
    """Distance before which the ray probably meets nothing."""
    jitter: np.ndarray
    """Fraction of a step before the first sample."""
    first: np.ndarray
    """Row of the first sample of each ray, and of what follows the last one."""
    end_transmittance: np.ndarray
    """T_end: what passes the whole ray."""


class Work(NamedTuple):
    """What the samples and rays of one chunk need on the way; d_x is the gradient by x."""

    per_ray: np.ndarray
    d_per_ray: np.ndarray
    hidden: np.ndarray
    rgb: np.ndarray
    d_color: np.ndarray
    d_log_density: np.ndarray
    d_weight: np.ndarray
    d_gain: np.ndarray
    d_shown: np.ndarray
    """By the colour of a ray before its gain."""


class Chunk(NamedTuple):
    """One part of a step: its rays and samples, and what they say of decoder and exposures, summed up."""

    rays: RayBatch
    samples: Samples
    work: Work
    gradient: Decoder
    gain_gradient: np.ndarray


def sample_buffers(capacity: int, width: int) -> Samples:
    """Arrays for so many samples with `width` features each."""
    return Samples(
        position=_floats(3 * capacity),
        distance=_floats(capacity),
        alpha=_floats(capacity),
        tau=_floats(capacity),
        transmittance=_floats(capacity),
        ray=np.zeros(capacity, dtype=np.int32),
        features=_floats((capacity + 1) * width),
    )


def part_of(samples: Samples, n: int, capacity: int, width: int) -> Samples:
    """Views of the n-th `capacity` samples."""

    def part(array: np.ndarray, size: int) -> np.ndarray:
        return array[n * capacity * size : (n + 1) * capacity * size]

    sizes = Samples(position=3, distance=1, alpha=1, tau=1, transmittance=1, ray=1, features=width)  # type: ignore[arg-type]
    return Samples(*(part(array, int(size)) for array, size in zip(samples, sizes, strict=True)))


def ray_buffers(count: int) -> RayBatch:
    """Arrays for so many rays."""
    return RayBatch(
        origins=_floats(3 * count),
        directions=_floats(3 * count),
        views=_floats(3 * count),
        target=_floats(3 * count),
        background=_floats(3 * count),
        image=np.zeros(count, dtype=np.int32),
        gain=_floats(3 * count),
        depth_row=np.zeros(count, dtype=np.int64),
        free_distance=_floats(count),
        jitter=_floats(count),
        first=np.zeros(count + 1, dtype=np.int64),
        end_transmittance=_floats(count),
    )


def work_buffers(num_rays: int, num_samples: int) -> Work:
    """Arrays for so many rays and samples."""
    return Work(
        per_ray=_floats(num_rays * HIDDEN),
        d_per_ray=_floats(num_rays * HIDDEN),
        hidden=_floats(num_samples * HIDDEN),
        rgb=_floats(3 * num_samples),
        d_color=_floats(3 * num_samples),
        d_log_density=_floats(num_samples),
        d_weight=_floats(num_samples),
        d_gain=_floats(3 * num_rays),
        d_shown=_floats(3 * num_rays),
    )


def _floats(count: int) -> np.ndarray:
    return np.zeros(count, dtype=np.float32)
