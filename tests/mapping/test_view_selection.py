import numpy as np

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.incremental.view_selection import spread

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, np.array([500.0, 320, 240]))


def brute_force(pixels: np.ndarray) -> int:
    score = 0
    for level in range(1, 7):
        cells = 2**level
        filled = {(int(x / 640 * cells), int(y / 480 * cells)) for x, y in pixels}
        score += len(filled) * cells * cells
    return score


def test_spread_matches_counting_cells():
    for seed, count in enumerate([0, 1, 5, 200]):
        pixels = np.random.default_rng(seed).uniform([0, 0], [640, 480], size=(count, 2))
        assert spread(CAMERA, pixels) == brute_force(pixels)


def test_spread_points_beat_clustered_ones():
    rng = np.random.default_rng(1)
    assert spread(CAMERA, rng.uniform([0, 0], [640, 480], (50, 2))) > spread(CAMERA, rng.uniform(0, 60, (500, 2)))
