"""The decoder of the grid field: interpolated features and a viewing direction to a colour.

    hidden = max(0, F f + D basis(d) + b),    rgb = sigmoid(C hidden + c)

One hidden layer, and the part that depends on the direction alone is computed once per ray.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fieldstone.field.grid.layout import CHANNELS

HIDDEN = 32
"""Hidden units."""

DIRECTIONS = 8
"""Functions of the direction: the spherical harmonics of degree 1 and 2, not normalised."""


class Decoder(NamedTuple):
    """The weights; float32, flat for the kernels. `width` is the number of interpolated values per sample.

    Rows of F that belong to log densities stay 0 and are never used.
    """

    feature_weights: np.ndarray
    """F transposed: (width, hidden)."""
    direction_weights: np.ndarray
    """D transposed: (8, hidden)."""
    hidden_bias: np.ndarray
    color_weights: np.ndarray
    """C: (3, hidden)."""
    color_bias: np.ndarray


def decoder_width(num_levels: int) -> int:
    """Values per sample that the kernels keep: 4 per level, rounded up to 8 lanes."""
    return -(-num_levels * CHANNELS // 8) * 8


def initial_decoder(width: int, rng: np.random.Generator) -> Decoder:
    """Uniform weights that keep the variance of layers with half of the units at rest.

    Source:
        `he2015`, section 2.2, eq. 10. Departure: directions start at 0.3, so that colours begin nearly the same
        from all sides.
    """

    def uniform(rows: int, bound: float) -> Float[np.ndarray, "n"]:
        return rng.uniform(-bound, bound, rows * HIDDEN).astype(np.float32)

    features = uniform(width, float(np.sqrt(3.0 / width)))
    features.reshape(width, HIDDEN)[::CHANNELS] = 0.0
    directions, colors = uniform(DIRECTIONS, 0.3), uniform(3, float(np.sqrt(3.0 / HIDDEN)))
    return Decoder(features, directions, np.zeros(HIDDEN, np.float32), colors, np.zeros(3, np.float32))


def direction_basis(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 8"]:
    """x, y, z, xy, yz, xz, x^2 - y^2, 3 z^2 - 1 of unit directions."""
    x, y, z = directions.T
    return np.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0], axis=1)


def decode(
    decoder: Decoder, features: Float[np.ndarray, "n w"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Colours in (0, 1); float64.

    Args:
        features: Interpolated values, level by level; log densities among them are ignored.
    """
    weights = decoder.feature_weights.reshape(-1, HIDDEN)[: features.shape[1]].astype(np.float64)
    weights[::CHANNELS] = 0.0
    hidden = features @ weights + direction_basis(directions) @ decoder.direction_weights.reshape(DIRECTIONS, HIDDEN)
    hidden = np.maximum(hidden + decoder.hidden_bias, 0.0)
    return 1.0 / (1.0 + np.exp(-(hidden @ decoder.color_weights.reshape(3, HIDDEN).T + decoder.color_bias)))
