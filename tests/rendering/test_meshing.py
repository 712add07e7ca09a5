"""A ball of known density to a mesh: distance, closedness, volume, colour; and what is cleaned away."""

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import look_at
from fieldstone.rendering.meshing import cleaned, colored, solidity, surface
from fieldstone.rendering.rasterize_numba import mesh_depth
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.rays import rays_from_view

RADIUS, SPACING = 0.7, 0.04
LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
CENTER = np.array([0.05, -0.02, 0.03])


def ball_density(points):
    """Falls off over two cells, so that the surface of level 0.5 is the ball of RADIUS."""
    distance = np.linalg.norm(points - CENTER, axis=1)
    share = np.clip(0.5 + (RADIUS - distance) / (4 * SPACING), 0.0, 1.0 - 1e-9)
    return -np.log1p(-share)


@pytest.fixture(scope="module")
def ball() -> Mesh:
    share, floaters = cleaned(solidity(ball_density, LOWER, UPPER, SPACING, 1.0), 0.5)
    assert floaters == 0
    return surface(share, 0.5, LOWER, SPACING, closed=True)


def test_the_surface_of_a_ball_is_the_sphere(ball):
    distance = np.linalg.norm(ball.vertices - CENTER, axis=1)
    # Linear interpolation is off by at most h^2 / 8 times the curvature; on edges of a cell that is 0.4 % of a cell.
    assert np.abs(distance - RADIUS).max() < 0.02 * SPACING
    # And no part of the sphere is far from a vertex: Hausdorff, the other way.
    directions = np.random.default_rng(0).normal(size=(500, 3))
    on_sphere = CENTER + RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    nearest = np.linalg.norm(on_sphere[:, None] - ball.vertices[None], axis=2).min(axis=1)
    assert nearest.max() < SPACING


def test_the_surface_is_closed_and_faces_outwards(ball):
    assert ball.is_closed()
    # An inscribed polyhedron of this cell size is smaller by less than 1 %; inside out, the volume would be negative.
    assert ball.volume() == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    normals = ball.vertex_normals()
    outwards = (ball.vertices - CENTER) / np.linalg.norm(ball.vertices - CENTER, axis=1, keepdims=True)
    assert np.sum(normals * outwards, axis=1).min() > 0.95


def test_colors_are_those_of_the_camera_in_front(ball):
    centers = np.array([[5.0, 0, 0], [-5.0, 0, 0]])

    def color(points, directions):
        return np.stack([points[:, 0] > 0, directions[:, 0] > 0, np.full(len(points), 0.5)], axis=1).astype(float)

    mesh = colored(ball, color, centers, 0.01)
    assert mesh.colors is not None
    front = mesh.vertices[:, 0] > 0.15
    np.testing.assert_array_equal(mesh.colors[front], np.broadcast_to([255, 0, 128], (int(np.count_nonzero(front)), 3)))
    back = mesh.vertices[:, 0] < -0.15
    np.testing.assert_array_equal(mesh.colors[back], np.broadcast_to([0, 255, 128], (int(np.count_nonzero(back)), 3)))


def test_floaters_and_hidden_holes_are_removed():
    share = np.zeros((30, 30, 30), dtype=np.float32)
    share[5:20, 5:20, 5:20] = 1.0
    share[10:14, 10:14, 10:14] = 0.0
    share[25, 25, 25] = 1.0
    clean, floaters = cleaned(share, 0.5)
    assert floaters == 1
    expected = np.zeros_like(share)
    expected[5:20, 5:20, 5:20] = 1.0
    np.testing.assert_array_equal(clean, expected)


def test_a_dent_is_no_hole():
    share = np.zeros((20, 20, 20), dtype=np.float32)
    share[5:15, 5:15, 5:15] = 1.0
    share[8:12, 8:12, 8:15] = 0.0
    np.testing.assert_array_equal(cleaned(share, 0.5)[0], share)


def test_matter_at_the_border_is_closed_or_open_as_asked():
    share = np.zeros((10, 10, 10), dtype=np.float32)
    share[:, :, :5] = 1.0
    closed = surface(share, 0.5, np.zeros(3), 1.0, closed=True)
    assert closed.is_closed()
    opened = surface(share, 0.5, np.zeros(3), 1.0, closed=False)
    # Only the plane between the fifth and the sixth layer is left.
    np.testing.assert_allclose(opened.vertices[:, 2], 4.5)
    np.testing.assert_allclose(np.ptp(opened.vertices, axis=0), [9, 9, 0])


def test_nothing_solid_is_an_error():
    with pytest.raises(InputError, match="dense"):
        cleaned(np.zeros((4, 4, 4)), 0.5)


def test_the_depth_buffer_sees_the_sphere(ball):
    camera = Camera("SIMPLE_PINHOLE", 60, 50, np.array([70.0, 30.0, 25.0]))
    pose = look_at(np.array([3.0, 0.5, 0.7]), CENTER, np.array([0.0, 0, 1]))
    depth = mesh_depth(ball, camera, pose).reshape(-1)
    rays = rays_from_view(camera, pose)
    offset = rays.origins - CENTER
    b = np.sum(offset * rays.directions, axis=1)
    discriminant = b**2 - np.sum(offset**2, axis=1) + RADIUS**2
    along_z = rays.directions @ pose.R[2]
    expected = (-b - np.sqrt(np.maximum(discriminant, 0))) * along_z
    clearly, outside = discriminant > 0.03, discriminant < -0.02
    np.testing.assert_allclose(depth[clearly], expected[clearly], atol=0.2 * SPACING)
    assert np.all(np.isinf(depth[outside]))
