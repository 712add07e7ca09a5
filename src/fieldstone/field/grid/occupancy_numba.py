"""Kernels for occupancy: distances between cells, carving, and which cells a field still uses."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.field.grid.interpolation_numba import interpolate_point_numba
from fieldstone.field.grid.march_numba import cut_to_slab, distance_at, steps_out_of_cell


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def carve_numba(cells, lower, cell_size, poses, intrinsics, sizes, sums, first, last):
    """Clear cells in slabs `first` to `last` whose projection meets no set pixel of one of the masks.

    cells: (x, y, z) bool. poses: (v, 3, 4) cam_from_box. intrinsics: (v, 4) focal lengths and principal point.
    sizes: (v, 2) width and height, in pixels of the masks. sums: (v, h + 1, w + 1) summed masks. A cell is the ball
    around it; nothing is cleared where the square around its projection leaves the photo, or reaches behind it.
    """
    radius = 0.5 * np.sqrt(3.0) * cell_size
    for i in range(first, last):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if cells[i, j, k]:
                    px = lower[0] + (i + 0.5) * cell_size
                    py = lower[1] + (j + 0.5) * cell_size
                    pz = lower[2] + (k + 0.5) * cell_size
                    for v in range(poses.shape[0]):
                        if _misses(px, py, pz, radius, poses[v], intrinsics[v], sizes[v], sums[v]):
                            cells[i, j, k] = False
                            break


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _misses(px, py, pz, radius, pose, intrinsics, size, sums):
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    if z <= radius:
        return False
    u, v = intrinsics[0] * x / z + intrinsics[2], intrinsics[1] * y / z + intrinsics[3]
    # A ball seen off axis covers less than its radius over the nearest depth, times the secant of the angle.
    reach = radius / (z - radius) * max(intrinsics[0], intrinsics[1]) * np.sqrt(1.0 + (x * x + y * y) / (z * z))
    if u - reach < 0.0 or v - reach < 0.0 or u + reach >= size[0] or v + reach >= size[1]:
        return False
    u0, u1, v0, v1 = int(u - reach), int(u + reach) + 1, int(v - reach), int(v + reach) + 1
    return sums[v1, u1] - sums[v0, u1] - sums[v1, u0] + sums[v0, u0] == 0


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def rays_that_hit(box, origin, directions, out):  # (3,), (r, 3) -> (r,) uint8
    """Which rays from one point meet an occupied cell of a bounded box."""
    zero = np.float32(0)
    ox, oy, oz = origin[0] - box.lower[0], origin[1] - box.lower[1], origin[2] - box.lower[2]
    ex, ey, ez = box.extent[0], box.extent[1], box.extent[2]
    nx, ny, nz = box.cells[0], box.cells[1], box.cells[2]
    per_cell = np.float32(1) / box.cell_size
    step = box.cell_size * np.float32(0.1)
    for ray in range(directions.shape[0]):
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        t, t_end = cut_to_slab(ox, dx, zero, ex, zero, np.float32(1e30))
        t, t_end = cut_to_slab(oy, dy, zero, ey, t, t_end)
        t, t_end = cut_to_slab(oz, dz, zero, ez, t, t_end)
        out[ray] = 0
        while t < t_end:
            x = min(max(ox + t * dx, zero), ex)
            y = min(max(oy + t * dy, zero), ey)
            z = min(max(oz + t * dz, zero), ez)
            i, j = min(np.int64(x * per_cell), nx - 1), min(np.int64(y * per_cell), ny - 1)
            k = min(np.int64(z * per_cell), nz - 1)
            distance = distance_at(box, i, j, k)
            if distance == 0:
                out[ray] = 1
                break
            t += step * steps_out_of_cell(box, step, distance, i, j, k, x, y, z, dx, dy, dz)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def used_cells(grid, cells, cell_size, spacing, density_bias, threshold, first, last):
    """Clear occupied cells in slabs `first` to `last` whose log density is at most `threshold` at all fine vertices.

    cells: (x, y, z) bool. spacing: between the vertices of the finest level; those on the faces count too.
    """
    row = np.empty(4 * grid.per_unit.shape[0], np.float32)
    for i in range(first, last):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if cells[i, j, k]:
                    cells[i, j, k] = _is_used(grid, cell_size, spacing, density_bias, threshold, i, j, k, row)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _is_used(grid, cell_size, spacing, density_bias, threshold, i, j, k, row):
    # One vertex beyond the faces, because its cell of influence reaches into this one.
    x0, x1 = int(i * cell_size / spacing), int((i + 1) * cell_size / spacing) + 1
    y0, y1 = int(j * cell_size / spacing), int((j + 1) * cell_size / spacing) + 1
    z0, z1 = int(k * cell_size / spacing), int((k + 1) * cell_size / spacing) + 1
    level = (grid.per_unit.shape[0] - 1) * 3
    x1, y1 = min(x1, grid.sizes[level] - 2), min(y1, grid.sizes[level + 1] - 2)
    z1 = min(z1, grid.sizes[level + 2] - 2)
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            for z in range(z0, z1 + 1):
                log_density = interpolate_point_numba(
                    grid, np.float32(x * spacing), np.float32(y * spacing), np.float32(z * spacing), row, 0
                )
                if log_density + density_bias > threshold:
                    return True
    return False
