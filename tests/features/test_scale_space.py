import numpy as np
import pytest
from scipy.ndimage import correlate1d, maximum_filter, minimum_filter

from fieldstone.features.scale_space_numba import (
    BORDER,
    DIFFERENCE_RING,
    LAYERS,
    SIGMA,
    _refine,
    empty_levels,
    octave_extrema_numba,
    octave_weights,
)


def blobs(height: int, width: int) -> np.ndarray:
    """Bright and dark Gaussian blobs of all sizes that an octave sees, float32."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:height, :width]
    out = np.full((height, width), 128.0)
    for _ in range(height * width // 50):
        x, y, sigma = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(2.0, 5.0)
        out += rng.choice([-60, 60]) * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    return out.astype(np.float32)


def blurred(image: np.ndarray, weights: np.ndarray) -> np.ndarray:
    kernel = np.concatenate([weights[:0:-1], weights]).astype(np.float64)
    return correlate1d(correlate1d(image, kernel, axis=0, mode="mirror"), kernel, mode="mirror")


def all_levels(first: np.ndarray) -> np.ndarray:
    """The six images of an octave, float64."""
    weights, radii = octave_weights()
    out = [first.astype(np.float64)]
    for s in range(1, LAYERS + 3):
        out.append(blurred(out[-1], weights[s, : radii[s] + 1]))
    return np.stack(out)


def test_every_image_is_blurred_by_a_third_of_an_octave_more():
    weights, radii = octave_weights()
    variance = SIGMA**2
    for s in range(1, LAYERS + 3):
        variance += 2 * np.sum(weights[s] * np.arange(weights.shape[1]) ** 2.0)
        assert not weights[s, radii[s] + 1 :].any()
        np.testing.assert_allclose(np.sqrt(variance), SIGMA * 2 ** (s / LAYERS), rtol=2e-3)


def newton_step(D: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Offset (x, y, s) of the extremum from (s, y, x), by central differences of the 27 values about it."""
    cube = D[tuple(slice(k - 1, k + 2) for k in at)].transpose(2, 1, 0)
    gradient = np.array([np.take(cube, 2, a)[1, 1] - np.take(cube, 0, a)[1, 1] for a in range(3)]) / 2
    H = np.empty((3, 3))
    for a in range(3):
        first = np.take(cube, 2, a) - np.take(cube, 0, a)
        for b in range(3):
            if a == b:
                H[a, a] = np.take(cube, 2, a)[1, 1] + np.take(cube, 0, a)[1, 1] - 2 * cube[1, 1, 1]
            else:
                along = np.moveaxis(first, (b if b < a else b - 1), 0)
                H[a, b] = (along[2, 1] - along[0, 1]) / 4
    return -np.linalg.solve(H, gradient)


@pytest.mark.parametrize("shape", [(90, 71), (33, 200), (16, 400)])
def test_extrema_are_those_of_all_images_held_at_once(shape):
    first = blobs(*shape)
    weights, radii = octave_weights()
    levels = empty_levels(first)
    # No threshold on contrast or edges: whatever is an extremum of 27 values, and of the parabola through them nearby.
    found = octave_extrema_numba(levels, weights, radii, np.float32(0.0), 1e9)
    expected = all_levels(first)
    for s in range(1, LAYERS + 1):
        np.testing.assert_allclose(levels[s], expected[s], rtol=1e-4, atol=1e-5 * 255)
    D = np.diff(expected, axis=0)
    is_extremum = ((maximum_filter(D, 3) == D) & (D > 0)) | ((minimum_filter(D, 3) == D) & (D < 0))
    is_extremum[[0, -1]] = is_extremum[:, :BORDER] = is_extremum[:, -BORDER:] = False
    is_extremum[:, :, :BORDER] = is_extremum[:, :, -BORDER:] = False
    at = np.argwhere(is_extremum)
    steps = np.array([newton_step(D, each) for each in at])
    settled = np.abs(steps).max(axis=1) < 0.45
    places = (at[:, ::-1] + steps)[settled]
    distance = np.abs(found[:, None, :3] - places).max(axis=2)
    assert settled.sum() >= 3
    # In float32, differences of grey levels of some hundreds are known to some 1e-5, of peaks of some units.
    assert np.all(distance.min(axis=0) < 1e-2)
    assert settled.sum() <= len(np.unique(found, axis=0)) <= len(found) <= len(at)


def parabola(centre: np.ndarray, H: np.ndarray, top: float) -> np.ndarray:
    """Values of top + (p - centre)^T H (p - centre) / 2 at (s, y, x), p = (x, y, s); rows are all kept."""
    s, y, x = np.meshgrid(np.arange(LAYERS + 2), np.arange(DIFFERENCE_RING), np.arange(16), indexing="ij")
    offset = np.stack([x, y, s], axis=-1) - centre
    return (top + 0.5 * np.einsum("...i,ij,...j->...", offset, H, offset)).astype(np.float32)


def refined(D: np.ndarray, start: tuple[int, int, int], least: float, max_edge_ratio: float) -> np.ndarray | None:
    """What the refinement from (x, y, s) finds."""
    x, y, s = start
    out = np.empty(4)
    return out if _refine(D, 16, s, y, x, least, max_edge_ratio, np.empty((3, 3, 3)), out) else None


@pytest.mark.parametrize("start", [(8, 7, 2), (9, 6, 2), (7, 8, 1)])
def test_the_extremum_of_a_parabola_is_found_exactly(start):
    centre = np.array([8.2, 7.3, 1.9])
    H = np.array([[-3.0, 0.4, 0.2], [0.4, -2.0, -0.3], [0.2, -0.3, -1.5]])
    found = refined(parabola(centre, H, 20.0), start, 1.0, 10.0)
    assert found is not None
    # Values of about 100 in float32.
    np.testing.assert_allclose(found, [*centre, 20.0], atol=1e-4)


def test_what_is_faint_or_lies_along_an_edge_or_at_the_border_is_left_out():
    centre, start = np.array([8.2, 7.3, 1.9]), (8, 7, 2)
    spot = parabola(centre, -np.diag([2.0, 2.0, 1.0]), 20.0)
    edge = parabola(centre, -np.diag([11.0, 1.0, 1.0]), 20.0)
    saddle = parabola(centre, np.diag([2.0, -2.0, 1.0]), 20.0)
    outside = parabola(np.array([3.8, 7.3, 1.9]), -np.diag([2.0, 2.0, 1.0]), 20.0)
    assert refined(spot, start, 19.9, 10.0) is not None
    assert refined(spot, start, 20.1, 10.0) is None
    assert refined(edge, start, 1.0, 10.0) is None
    assert refined(edge, start, 1.0, 12.0) is not None
    assert refined(saddle, start, 1.0, 10.0) is None
    assert refined(outside, (5, 7, 2), 1.0, 10.0) is None
    assert refined(np.full((5, 16, 16), 3.0, dtype=np.float32), start, 1.0, 10.0) is None
