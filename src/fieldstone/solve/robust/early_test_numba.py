"""The sequential probability ratio test that rejects bad models after a few correspondences."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit


class EarlyTest(NamedTuple):
    """Log likelihood ratios, under a bad against a good model, of an inlier and an outlier; the sum that rejects."""

    gain_in: float
    gain_out: float
    log_limit: float


ACCEPT_ALL = EarlyTest(0.0, 0.0, float("inf"))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def early_test_numba(good_ratio, bad_ratio, solver_cost):
    """Log likelihood ratios of an inlier and an outlier under a bad against a good model, and the limit that rejects.

    The limit A minimises the mean time per good model: A = 1 + t C + log A, with C the mean gain per point.

    Source:
        `matas2005`, section 3, and `chum2008`, eq. 18.
    """
    if bad_ratio >= 0.9 * good_ratio or good_ratio > 0.999:
        return ACCEPT_ALL
    gain_in = np.log(bad_ratio / good_ratio)
    gain_out = np.log((1.0 - bad_ratio) / (1.0 - good_ratio))
    information = bad_ratio * gain_in + (1.0 - bad_ratio) * gain_out
    A = 1.0 + solver_cost * information
    limit = A
    for _ in range(5):
        limit = A + np.log(limit)
    return EarlyTest(gain_in, gain_out, np.log(limit))
