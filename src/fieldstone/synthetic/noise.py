"""Random patterns on the plane, of which the materials of a synthetic building are made."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float


def fractal(
    shape: tuple[int, int], texel: float, largest: float, octaves: int, rng: np.random.Generator, *, gain: float = 0.6
) -> Float[np.ndarray, "h w"]:
    """Multi-octave value noise with mean near 0 and standard deviation near 1, float32.

    Args:
        shape: Rows and columns of the result.
        texel: Size of one texel; the same unit as `largest`.
        largest: Wavelength of the coarsest octave; each next one is half as long and `gain` as strong. Octaves
            finer than two texels are left out.
    """
    height, width = shape
    out = np.zeros(shape, dtype=np.float32)
    power = 0.0
    for octave in range(octaves):
        step = largest / 2**octave / texel
        if step < 1.0 and octave:
            break
        rows, cols = int(height / step) + 4, int(width / step) + 4
        lattice = rng.standard_normal((rows, cols), dtype=np.float32)
        fine = cv2.resize(lattice, (int(cols * step) + 1, int(rows * step) + 1), interpolation=cv2.INTER_CUBIC)
        top, left = (int(rng.integers(0, n - m + 1)) for n, m in zip(fine.shape, shape, strict=True))
        out += gain**octave * fine[top : top + height, left : left + width]
        power += gain ** (2 * octave) * 0.5
    return out / np.float32(np.sqrt(max(power, 1e-12)))


def cells(
    x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"], size: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Cellular pattern around one random centre in each square of a lattice.

    Args:
        x, y: Coordinates of the texels.
        size: Side of a lattice square, in the unit of x and y.

    Returns:
        Distance to the nearest centre and to the second nearest, in units of `size`, and three numbers in [0, 1)
        that are the same all over a cell.

    Source:
        `worley1996`, section 2. Departure: one centre a square, so nine squares always suffice for the nearest.
    """
    gx, gy = (x - x.min()) / size + 1.0, (y - y.min()) / size + 1.0
    shape = (int(gy.max()) + 3, int(gx.max()) + 3)
    center = rng.uniform(0.1, 0.9, size=(*shape, 2)).astype(np.float32)
    label = rng.random(size=(*shape, 3), dtype=np.float32)
    column, row = gx.astype(np.int32), gy.astype(np.int32)
    nearest = np.full(x.shape, np.inf, dtype=np.float32)
    second = np.full(x.shape, np.inf, dtype=np.float32)
    labels = np.zeros((*x.shape, 3), dtype=np.float32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            r, c = row + dy, column + dx
            distance = np.hypot(c + center[r, c, 0] - gx, r + center[r, c, 1] - gy).astype(np.float32)
            closer = distance < nearest
            second = np.where(closer, nearest, np.minimum(second, distance))
            nearest = np.where(closer, distance, nearest)
            labels[closer] = label[r, c][closer]
    return nearest, second, labels


def smoothstep(x: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, a cubic between; `low` may lie above `high` for a falling step."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
