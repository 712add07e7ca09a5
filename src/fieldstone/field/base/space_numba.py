"""`space` inside kernels: one point, one ray, scalars."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def contract_numba(x, y, z, half_side):
    """`space.grid_from_normalized` of one point of a contracted space; before and after relative to the lower corner.

    Returns (x, y, z, reach), reach at least 1; the `space.stretch` there is its square.
    """
    one, two = np.float32(1), np.float32(2)
    cx, cy, cz = x / half_side - two, y / half_side - two, z / half_side - two
    reach = max(abs(cx), max(abs(cy), abs(cz)))
    if reach <= one:
        return x, y, z, one
    s = (two - one / reach) / reach
    return (two + cx * s) * half_side, (two + cy * s) * half_side, (two + cz * s) * half_side, reach


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def project_ray_numba(projection, origins, directions, ray):
    """`projection.project_rays` of one ray, in place; what does not look ahead points out of the box."""
    o, d = np.empty(3, np.float32), np.empty(3, np.float32)
    for a in range(3):
        o[a], d[a] = 0, 0
        for b in range(3):
            o[a] += projection.R[a, b] * (origins[ray * 3 + b] - projection.center[b])
            d[a] += projection.R[a, b] * directions[ray * 3 + b]
    near = projection.near
    if d[2] <= np.float32(1e-3):
        origins[ray * 3], origins[ray * 3 + 1], origins[ray * 3 + 2] = o[0] / near, o[1] / near, 0
        directions[ray * 3], directions[ray * 3 + 1], directions[ray * 3 + 2] = 0, 0, -1
        return
    x, y = (o[0] + (near - o[2]) / d[2] * d[0]) / near, (o[1] + (near - o[2]) / d[2] * d[1]) / near
    dx, dy, dz = d[0] / d[2] - x, d[1] / d[2] - y, projection.depth
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    origins[ray * 3], origins[ray * 3 + 1], origins[ray * 3 + 2] = x, y, 0
    directions[ray * 3], directions[ray * 3 + 1], directions[ray * 3 + 2] = dx / length, dy / length, dz / length
