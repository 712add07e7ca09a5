from functools import partial

import numpy as np
import pytest

from fieldstone.features.nearest import NO_SECOND, squared_distances, two_nearest
from fieldstone.features.nearest_numba import BLOCK_ROWS, HAS_BYTE_PRODUCTS, two_nearest_numba

KERNELS = [
    pytest.param(partial(two_nearest_numba, by_bytes=False), id="words"),
    pytest.param(
        partial(two_nearest_numba, by_bytes=True),
        id="bytes",
        marks=pytest.mark.skipif(not HAS_BYTE_PRODUCTS, reason="this processor has no vpdpbusd"),
    ),
]
IMPLEMENTATIONS = [two_nearest, *KERNELS]


def by_sorting(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index and the two smallest distances of each row, from all differences."""
    distance = np.array([((row.astype(int) - b.astype(int)) ** 2).sum(axis=1) for row in a])
    order = np.argsort(distance, axis=1, kind="stable")
    in_order = np.take_along_axis(distance, order, axis=1)
    second = in_order[:, 1] if len(b) > 1 else np.full(len(a), NO_SECOND)
    return order[:, 0], in_order[:, 0], second


@pytest.mark.parametrize("nearest", IMPLEMENTATIONS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (5, 17), (16, 4), (67, 130), (BLOCK_ROWS + 3, 33)])
@pytest.mark.parametrize("high", [3, 256], ids=["many ties", "all bytes"])
def test_the_two_nearest_are_those_of_sorting(nearest, shape, high):
    rng = np.random.default_rng([*shape, high])
    a, b = (rng.integers(0, high, size=(n, 128)).astype(np.uint8) for n in shape)
    b[len(b) // 2 :] = b[: len(b) - len(b) // 2]
    for found, (x, y) in zip(nearest(a, b), ((a, b), (b, a)), strict=True):
        index, first, second = by_sorting(x, y)
        np.testing.assert_array_equal(found.index, index)
        np.testing.assert_array_equal(found.nearest, first)
        np.testing.assert_array_equal(found.second, second)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("d", [1, 2, 7, 64, 256])
def test_kernel_agrees_with_the_reference_for_any_length(d, kernel):
    rng = np.random.default_rng(d)
    a, b = (rng.integers(0, 256, size=(n, d)).astype(np.uint8) for n in (90, 75))
    for found, expected in zip(kernel(a, b), two_nearest(a, b), strict=True):
        np.testing.assert_array_equal(found.index, expected.index)
        np.testing.assert_array_equal(found.nearest, expected.nearest)
        np.testing.assert_array_equal(found.second, expected.second)


@pytest.mark.parametrize("nearest", IMPLEMENTATIONS)
def test_the_largest_distance_is_exact(nearest):
    a, b = np.full((2, 256), 255, dtype=np.uint8), np.zeros((3, 256), dtype=np.uint8)
    from_a, from_b = nearest(a, b)
    assert from_a.nearest.tolist() == from_a.second.tolist() == [255**2 * 256] * 2
    assert from_b.nearest.tolist() == [255**2 * 256] * 3
    np.testing.assert_array_equal(squared_distances(a, b), np.full((2, 3), 255**2 * 256))


@pytest.mark.parametrize("nearest", IMPLEMENTATIONS)
def test_sets_that_cannot_be_compared_are_refused(nearest):
    rows = np.zeros((3, 128), dtype=np.uint8)
    with pytest.raises(ValueError, match="got 0 and 3"):
        nearest(rows[:0], rows)
    with pytest.raises(ValueError, match="at most 256"):
        nearest(np.zeros((3, 300), dtype=np.uint8), np.zeros((3, 300), dtype=np.uint8))


def test_ratio_test_compares_distances_not_squares():
    a = np.zeros((1, 128), dtype=np.uint8)
    b = np.zeros((2, 128), dtype=np.uint8)
    b[0, 0], b[1, 0] = 79, 100
    found, _ = two_nearest_numba(a, b)
    assert found.distinct(0.8).tolist() == [True]
    assert found.distinct(0.78).tolist() == [False]
    b[1, 0] = 79
    assert two_nearest_numba(a, b)[0].distinct(0.999).tolist() == [False]
