"""Compiled counting sorts behind the layout of a bundle problem."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def counting_order_numba(keys, num_keys):  # (n,) -> (n,), (num_keys + 1,)
    """Order that sorts integer keys in 0..num_keys-1 stably, as `np.argsort(kind="stable")`, and where each starts."""
    starts = np.zeros(num_keys + 1, dtype=np.int64)
    for i in range(len(keys)):
        starts[keys[i] + 1] += 1
    for k in range(num_keys):
        starts[k + 1] += starts[k]
    place = starts[:num_keys].copy()
    order = np.empty(len(keys), dtype=np.int64)
    for i in range(len(keys)):
        order[place[keys[i]]] = i
        place[keys[i]] += 1
    return order, starts


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def coupled_cameras_numba(point_start, camera, shared_row):
    """Distinct cameras with shared intrinsics that see each point.

    Returns the coupling of each observation (-1: none), the start of each point's couplings, and their cameras.
    """
    num_points = len(point_start) - 1
    coupling_of_obs = np.full(len(camera), -1, dtype=np.int64)
    coupling_start = np.zeros(num_points + 1, dtype=np.int64)
    coupling_camera = np.empty(len(camera), dtype=np.int64)
    count = 0
    for p in range(num_points):
        coupling_start[p] = count
        for o in range(point_start[p], point_start[p + 1]):
            c = camera[o]
            if shared_row[c] < 0:
                continue
            e = coupling_start[p]
            while e < count and coupling_camera[e] != c:
                e += 1
            if e == count:
                coupling_camera[e] = c
                count += 1
            coupling_of_obs[o] = e
    coupling_start[num_points] = count
    return coupling_of_obs, coupling_start, coupling_camera[:count].copy()
