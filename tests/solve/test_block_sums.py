"""Sums of blocks have the order that their source states, to the last bit, whoever calls them."""

import math

import numpy as np
import pytest
from numba import njit

from fieldstone.solve.algebra.block_sums_numba import BLOCK, LANES, block_dot, block_sum


@njit
def sum_of(values, begin):
    return block_sum(values, begin)  # pyright: ignore[reportCallIssue]


@njit
def dot_of(values, begin1, begin2):
    return block_dot(values, begin1, begin2)  # pyright: ignore[reportCallIssue]


def in_stated_order(values: np.ndarray) -> float:
    """Lane by lane, one row of lanes after the other; then lanes in pairs."""
    lanes = values[:LANES].copy()
    for row in values.reshape(-1, LANES)[1:]:
        lanes += row
    while len(lanes) > 1:
        lanes = lanes[::2] + lanes[1::2]
    return float(lanes[0])


@pytest.fixture
def values() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.normal(size=3 * BLOCK + 5) * 10.0 ** rng.integers(-8, 8, 3 * BLOCK + 5)


@pytest.mark.parametrize("begin", [0, 1, BLOCK, 2 * BLOCK + 5])
def test_sum_has_the_stated_order(values, begin):
    block = values[begin : begin + BLOCK]
    assert sum_of(values, begin) == in_stated_order(block)
    assert sum_of(values, begin) == pytest.approx(math.fsum(block), rel=1e-12)


@pytest.mark.parametrize(("begin1", "begin2"), [(0, 0), (BLOCK, 3), (7, 2 * BLOCK + 5)])
def test_dot_has_the_stated_order_and_no_fused_products(values, begin1, begin2):
    products = values[begin1 : begin1 + BLOCK] * values[begin2 : begin2 + BLOCK]
    assert dot_of(values, begin1, begin2) == in_stated_order(products)
