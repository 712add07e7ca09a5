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
def border_entries_numba(point_start, camera, border_of_camera):
    """Distinct border cameras of every point: entry of each observation (-1: none), entry starts, entry cameras."""
    num_points = len(point_start) - 1
    entry_of_obs = np.full(len(camera), -1, dtype=np.int64)
    entry_start = np.zeros(num_points + 1, dtype=np.int64)
    entry_camera = np.empty(len(camera), dtype=np.int64)
    count = 0
    for p in range(num_points):
        entry_start[p] = count
        for o in range(point_start[p], point_start[p + 1]):
            c = camera[o]
            if border_of_camera[c] < 0:
                continue
            e = entry_start[p]
            while e < count and entry_camera[e] != c:
                e += 1
            if e == count:
                entry_camera[e] = c
                count += 1
            entry_of_obs[o] = e
    entry_start[num_points] = count
    return entry_of_obs, entry_start, entry_camera[:count].copy()
