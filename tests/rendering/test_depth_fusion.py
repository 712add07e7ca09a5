"""Depths of exact views against the surface that they came from."""

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import look_at
from fieldstone.rendering.depth_fusion import REACH, fused
from fieldstone.rendering.meshing import cleaned
from fieldstone.scene.rays import rays_from_view

CAMERA = Camera("SIMPLE_PINHOLE", 200, 160, np.array([230.0, 100.0, 80.0]))
RADIUS, SPACING, LOWER = 0.8, 0.08, np.full(3, -1.2)
CELLS = 30


def position(index):
    return LOWER + SPACING * index


def distances():
    """Of the grid points from the middle."""
    index = np.stack(np.meshgrid(*[np.arange(CELLS + 1)] * 3, indexing="ij"), axis=-1)
    return np.linalg.norm(position(index), axis=-1)


def views(n=40):
    """Depths of a ball at the origin from all around."""
    rng = np.random.default_rng(0)
    for _ in range(n):
        eye = rng.normal(size=3)
        pose = look_at(4.0 * eye / np.linalg.norm(eye), np.zeros(3), np.array([0.0, 0.1, 1.0]))
        rays = rays_from_view(CAMERA, pose)
        b = np.sum(rays.origins * rays.directions, axis=1)
        discriminant = b**2 - np.sum(rays.origins**2, axis=1) + RADIUS**2
        depth = np.where(discriminant > 0, -b - np.sqrt(np.maximum(discriminant, 0)), np.inf)
        yield CAMERA, pose, depth.reshape(CAMERA.height, CAMERA.width)


def radius_of(grid):
    """Where the grid crosses one half, along an axis from the middle."""
    line = grid[CELLS // 2 :, CELLS // 2, CELLS // 2]
    k = int(np.flatnonzero(line < 0.5)[0])
    return SPACING * (k - 1 + (line[k - 1] - 0.5) / (line[k - 1] - line[k]))


@pytest.mark.parametrize("wrong", [0.6, 0.8, 1.0])
def test_the_surface_is_where_the_views_see_it_and_not_where_the_density_ends(wrong):
    """The given grid is a ball of another radius, off by less than the reach of three steps.

    What lies behind the surface in all views stays as it was, a hollow within the solid; such are filled later.
    """
    grid, floaters = cleaned(fused((distances() < wrong).astype(np.float32), 0.5, position, views()), 0.5)
    assert floaters == 0
    assert abs(radius_of(grid) - RADIUS) < 0.15 * SPACING
    assert np.all(grid[distances() < RADIUS - SPACING] > 0.5)
    assert np.all(grid[distances() > RADIUS + SPACING] < 0.5)


def test_what_no_view_sees_stays():
    solid = (distances() < RADIUS).astype(np.float32)
    np.testing.assert_array_equal(fused(solid, 0.5, position, ()), solid)


def test_far_from_the_surface_nothing_is_asked():
    def nothing_there():
        for camera, pose, depth in views(3):
            yield camera, pose, np.full_like(depth, np.inf)

    grid = fused((distances() < RADIUS).astype(np.float32), 0.5, position, nothing_there())
    assert np.all(grid[distances() < RADIUS - 2 * REACH * SPACING] == 1.0)
    assert np.all(grid[distances() > RADIUS + 2 * REACH * SPACING] == 0.0)
    # Within reach, views that look through carve.
    assert np.all(grid[np.abs(distances() - RADIUS) < SPACING] == 0.0)
