"""Frequency encodings of positions and directions: the readable reference of what the networks take in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def encoded_size(num_frequencies: int) -> int:
    """Numbers that encode one 3-vector: the vector itself, and a sine and a cosine of it per frequency."""
    return 3 * (1 + 2 * num_frequencies)


def frequency_encoding(x: Float[np.ndarray, "*n 3"], num_frequencies: int) -> Float[np.ndarray, "*n k"]:
    """gamma(x) = (x, sin(2^0 x), ..., sin(2^(L-1) x), cos(2^0 x), ..., cos(2^(L-1) x)), k = 3 (1 + 2 L).

    For positions and for unit viewing directions alike: the "positional" and the "directional" encoding.

    Source:
        `mildenhall2020`, eq. 4. Departures, both those of the authors' released program: frequencies without the
        factor pi (positions are of the order of 1.5, not 1), and x itself goes in too.
    """
    angles = x[..., None, :] * 2.0 ** np.arange(num_frequencies)[:, None]  # (*n, L, 3)
    waves = np.concatenate([np.sin(angles), np.cos(angles)], axis=-2)
    return np.concatenate([x, waves.reshape(*x.shape[:-1], 6 * num_frequencies)], axis=-1)
