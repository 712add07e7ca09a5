"""Gaussian splats: their colours, their views, and splats of a known surface."""

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.rotation import random_rotation
from fieldstone.rendering.meshing import surface
from fieldstone.rendering.splat_view_numba import DILATION, splat_view
from fieldstone.rendering.splatting import splats_of_surface
from fieldstone.scene.splats import NUM_SH, SH_C0, Splats, sh_basis, splat_colors

CAMERA = Camera("SIMPLE_PINHOLE", 41, 41, np.array([50.0, 20.5, 20.5]))
AT_ORIGIN = Rigid3(np.eye(3), np.zeros(3))


def constant(colors):
    sh = np.zeros((len(colors), NUM_SH, 3))
    sh[:, 0] = (np.asarray(colors) - 0.5) / SH_C0
    return sh


def test_the_basis_is_orthonormal_on_the_sphere():
    # Gauss-Legendre in z and equal angles integrate these polynomials exactly.
    z, weight = np.polynomial.legendre.leggauss(6)
    angle = 2 * np.pi * np.arange(12) / 12
    r = np.sqrt(1 - z**2)
    directions = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.outer(z, np.ones(12))], axis=-1)
    basis = sh_basis(directions)
    gram = np.einsum("zak,zal,z->kl", basis, basis, weight) * 2 * np.pi / 12
    np.testing.assert_allclose(gram, np.eye(NUM_SH), atol=1e-12)


def test_one_splat_is_a_gaussian_in_the_image():
    sigma, depth, color = 0.1, 2.0, np.array([0.2, 0.6, 0.9])
    turn = random_rotation(1, np.random.default_rng(0))
    splats = Splats(np.array([[0.0, 0.0, depth]]), turn, np.full((1, 3), sigma), np.array([0.8]), constant([color]))
    seen = splat_view(splats, CAMERA, AT_ORIGIN, np.ones(3))
    v, u = np.mgrid[:41, :41] + 0.5 - 20.5
    squared = (u**2 + v**2) / ((50.0 * sigma / depth) ** 2 + DILATION)
    alpha = 0.8 * np.exp(-squared / 2) * (squared < 8.0)
    inside = squared < 8.0
    expected = 1.0 + alpha[..., None] * (color - 1.0)
    np.testing.assert_allclose(seen[inside], expected[inside], rtol=1e-9)


def test_nearer_splats_cover_those_behind_and_what_is_behind_the_camera_is_not_seen():
    means = np.array([[0, 0, 3.0], [0, 0, 2.0], [0, 0, -1.0]])
    splats = Splats(means, np.tile(np.eye(3), (3, 1, 1)), np.full((3, 3), 0.2), np.full(3, 0.9), constant(np.eye(3)))
    middle = splat_view(splats, CAMERA, AT_ORIGIN, np.zeros(3))[20, 20]
    np.testing.assert_allclose(middle, [0.1 * 0.9, 0.9, 0.0], rtol=1e-9)


def ball(cells=28):
    """The unit sphere by marching cubes."""
    at = np.linspace(-1.2, 1.2, cells + 1)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    share = np.clip(0.5 + 2.0 * (1.0 - np.sqrt(x**2 + y**2 + z**2)), 0.0, 1.0).astype(np.float32)
    return surface(share, 0.5, np.full(3, -1.2), 2.4 / cells, closed=True)


def test_a_surface_keeps_its_colours_from_all_sides():
    rng = np.random.default_rng(1)
    mesh = ball()
    eyes = rng.normal(size=(40, 3))
    eyes *= 4 / np.linalg.norm(eyes, axis=1, keepdims=True)
    slope = np.array([0.2, -0.1, 0.15])

    def colors_from(points):
        return lambda directions: 0.5 + 0.2 * points + (directions @ slope)[:, None]

    splats = splats_of_surface(mesh, colors_from, eyes, 0.0)
    assert len(splats) == len(mesh.vertices)
    # The third axis is the normal, and rotations are rotations.
    np.testing.assert_allclose(np.linalg.det(splats.axes), 1.0, rtol=1e-9)
    assert np.sum(splats.axes[:, :, 2] * mesh.vertices, axis=1).min() > 0.99
    eye = eyes[3]
    ahead = mesh.vertices - eye
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    facing = np.sum(ahead * mesh.vertices, axis=1) < -0.3
    expected = colors_from(mesh.vertices)(ahead)
    found = splat_colors(splats, eye)
    assert np.abs(found - expected)[facing].max() < 0.02
    # The disc of the sphere is covered, and nothing beyond it.
    camera = Camera("SIMPLE_PINHOLE", 101, 101, np.array([150.0, 50.5, 50.5]))
    seen = splat_view(splats, camera, look_at(eye, np.zeros(3), np.array([0.0, 0, 1])), np.full(3, 5.0))
    v, u = np.mgrid[:101, :101] + 0.5 - 50.5
    radius = np.hypot(u, v) / (150.0 / np.sqrt(15.0))
    # One layer of splats lets a sixth through, and there are two.
    assert seen[radius < 0.9].max() < 1.5
    np.testing.assert_allclose(seen[radius > 1.1], 5.0)


@pytest.mark.parametrize("missing", [np.zeros((0, 3))])
def test_no_splats_show_the_background(missing):
    splats = Splats(missing, np.zeros((0, 3, 3)), missing, np.zeros(0), np.zeros((0, NUM_SH, 3)))
    np.testing.assert_array_equal(splat_view(splats, CAMERA, AT_ORIGIN, np.full(3, 0.3)), np.full((41, 41, 3), 0.3))
