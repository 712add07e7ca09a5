import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from fieldstone.features.descriptors_numba import (
    CELLS,
    DESCRIPTOR_SCALE,
    DESCRIPTOR_SIDE,
    DIRECTIONS,
    MAX_ORIENTATIONS,
    ORIENTATION_SIDE,
    SAMPLES_PER_CELL,
    STEP,
    _polar,
    cell_weights,
    descriptors_numba,
    orientation_weights,
    orientations_numba,
    sample_grid,
)
from fieldstone.features.scale_space_numba import LAYERS, SIGMA

LEVEL = 1.8


def described(image: np.ndarray, x: float, y: float, angle: float) -> np.ndarray:
    """The descriptor of one keypoint of `LEVEL`."""
    levels = (image.astype(np.float32),) * LAYERS
    keypoints = np.array([[x, y, LEVEL, 1.0]])
    return descriptors_numba(levels, keypoints, np.array([angle]), sample_grid(DESCRIPTOR_SIDE), cell_weights())[0]


def orientations(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """The orientations of one keypoint of `LEVEL`."""
    levels, angles = (image.astype(np.float32),) * LAYERS, np.zeros((1, MAX_ORIENTATIONS))
    keypoints = np.array([[x, y, LEVEL, 1.0]])
    count = orientations_numba(levels, keypoints, sample_grid(ORIENTATION_SIDE), orientation_weights(), angles)
    return angles[0, : count[0]]


def reference(image: np.ndarray, x: float, y: float, angle: float) -> np.ndarray:
    """The descriptor as sums over all samples and cells, float64, before it is rounded."""
    half = (CELLS + 1) / 2
    at = (np.arange(-1, (CELLS + 1) * SAMPLES_PER_CELL + 1) + 0.5) / SAMPLES_PER_CELL - half  # in cells
    u, v = np.meshgrid(at, at)
    cell = STEP * SAMPLES_PER_CELL * SIGMA * 2 ** (LEVEL / LAYERS)
    c, s = np.cos(angle), np.sin(angle)
    places = np.stack([y + cell * (s * u + c * v), x + cell * (c * u - s * v)])
    patch = map_coordinates(image.astype(np.float64), places, order=1, mode="nearest")
    dx, dy = patch[1:-1, 2:] - patch[1:-1, :-2], patch[2:, 1:-1] - patch[:-2, 1:-1]
    u, v = u[1:-1, 1:-1], v[1:-1, 1:-1]
    length = np.hypot(dx, dy) * np.exp(-(u**2 + v**2) / (2 * (CELLS / 2) ** 2))
    direction = -np.arctan2(dy, dx) * DIRECTIONS / (2 * np.pi)
    out = np.zeros((CELLS, CELLS, DIRECTIONS))
    for row in range(CELLS):
        for column in range(CELLS):
            share = np.maximum(1 - np.abs(v - row + (CELLS - 1) / 2), 0)
            share = share * np.maximum(1 - np.abs(u - column + (CELLS - 1) / 2), 0)
            for k in range(DIRECTIONS):
                apart = np.abs((direction - k + DIRECTIONS / 2) % DIRECTIONS - DIRECTIONS / 2)
                out[row, column, k] = np.sum(length * share * np.maximum(1 - apart, 0))
    values = np.minimum(out.ravel(), 0.2 * np.linalg.norm(out))
    return np.minimum(DESCRIPTOR_SCALE * np.sqrt(values / values.sum()), 255.0)


def texture(seed: int, size: int = 90) -> np.ndarray:
    """Noise that is as blurred as the image in which a keypoint is described."""
    return 2000 * gaussian_filter(np.random.default_rng(seed).normal(size=(size, size)), SIGMA * 2 ** (LEVEL / LAYERS))


@pytest.mark.parametrize(("x", "y"), [(44.3, 45.8), (6.2, 40.0), (88.0, 3.1), (89.0, 89.0)])
@pytest.mark.parametrize("angle", [0.0, 0.7, 3.0, 5.9])
def test_descriptors_are_the_square_roots_of_shares_of_gradients(x, y, angle):
    image = texture(1)
    expected = reference(image, x, y, angle)
    found = described(image, x, y, angle)
    # Half for rounding, the rest for float32.
    assert np.max(np.abs(found - expected)) < 0.6
    np.testing.assert_allclose(np.linalg.norm(found.astype(float)), DESCRIPTOR_SCALE, rtol=5e-3)


def test_a_flat_place_has_no_orientation_and_no_descriptor():
    flat = np.full((60, 60), 7.0)
    assert not len(orientations(flat, 30, 30))
    assert not described(flat, 30, 30, 0.3).any()


@pytest.mark.parametrize("angle", np.linspace(0.0, 2 * np.pi, 13)[:-1] + 0.03)
def test_the_orientation_is_the_direction_of_a_slope(angle):
    row, column = np.mgrid[:60, :60]
    slope = np.cos(angle) * column + np.sin(angle) * row
    found = orientations(slope, 30.2, 29.7)
    assert len(found) == 1
    # The histogram is linear between its bins, and the parabola through three of them nearly so.
    assert abs(np.angle(np.exp(1j * (found[0] - angle)))) < np.deg2rad(0.5)
    # Along it all gradients have the first direction.
    values = described(slope, 30.2, 29.7, angle).reshape(CELLS, CELLS, DIRECTIONS)
    assert values[..., 0].min() > 50
    assert values[..., 1:].max() < 10


def test_two_slopes_that_meet_give_two_orientations():
    row, column = np.mgrid[:80, :80]
    ridge = np.where(column + row < 80, column, row).astype(float)
    found = orientations(ridge, 40.0, 40.0)
    np.testing.assert_allclose(np.sort(found), [0.0, np.pi / 2], atol=np.deg2rad(4.0))


def test_lengths_and_directions_of_gradients():
    rng = np.random.default_rng(3)
    dx, dy = (rng.normal(size=1000).astype(np.float32) for _ in range(2))
    dx[:8], dy[:8] = [0, 1, 0, -1, 0, 1, 1e-8, -0.0], [0, 0, 1, 0, -1, -1, 1, 0.0]
    zero, length, direction = (np.zeros(1000, dtype=np.float32) for _ in range(3))
    _polar(zero, dx, zero, dy, np.float32(1.0), np.float32(2 * np.pi), length, direction)
    np.testing.assert_allclose(length, np.hypot(dx, dy), rtol=1e-6)
    apart = np.angle(np.exp(1j * (direction[1:].astype(float) - np.arctan2(dy[1:], dx[1:]))))
    assert np.abs(apart[:6]).max() < 3e-6
    assert np.abs(apart[7:]).max() < 3e-6
    assert direction.min() >= 0.0
    assert direction.max() <= np.float32(2 * np.pi)
