"""A coloured surface to Gaussian splats: one flat splat at every vertex, as wide as the surface around it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from fieldstone.scene.mesh import Mesh
from fieldstone.scene.splats import NUM_SH, SH_C0, Splats, sh_basis

ColorsFrom = Callable[[Float[np.ndarray, "n 3"]], Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]]
"""Points to a function from the unit directions in which they are seen to their colours in [0, 1]."""

OPACITY = 0.95

WIDTH, THICKNESS = 0.55, 0.1
"""Standard deviation along the surface, in square roots of a vertex's share of it, and across, in lengths of edges."""

MIN_WIDTH, MAX_WIDTH = 0.3, 1.0
"""Bounds of the former, in lengths of the edges around: marching cubes leaves slivers."""

SINK = 1.0
"""Splats lie so many lengths of edges below the surface: they reach beyond their middle, and viewers widen them."""

NUM_EYES = 32
"""Colours are asked for from this many cameras."""

RIDGE = 0.02
"""Pull of the coefficients of degree 1 and 2 to 0, against the weights of the cameras that face the surface."""

AT_ONCE = 1 << 15


def splats_of_surface(mesh: Mesh, colors_from: ColorsFrom, eyes: Float[np.ndarray, "c 3"], depth: float) -> Splats:
    """Splats on the vertices of a mesh, with colours fitted to what the field shows to the cameras.

    Args:
        eyes: Centres of the cameras, in the frame of the mesh.
        depth: How far behind the surface colours are taken: on it, half of the neighbours are empty.
    """
    normals = mesh.vertex_normals()
    used = np.flatnonzero(np.linalg.norm(normals, axis=1) > 0.5)
    normals = normals[used]
    area, length = (sums[used] for sums in _around_vertices(mesh))
    width = np.clip(WIDTH * np.sqrt(area), MIN_WIDTH * length, MAX_WIDTH * length)
    scales = np.stack([width, width, THICKNESS * length], axis=1)
    chosen = eyes[np.unique(np.linspace(0, len(eyes) - 1, NUM_EYES).astype(np.int64))]
    surface, sh = mesh.vertices[used], np.empty((len(used), NUM_SH, 3))
    for start in range(0, len(used), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        sh[rows] = _fitted(surface[rows], normals[rows], colors_from(surface[rows] - depth * normals[rows]), chosen)
    means = surface - (SINK * length)[:, None] * normals
    return Splats(means, _axes(normals), scales, np.full(len(used), OPACITY), sh)


def _around_vertices(mesh: Mesh) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """A third of the area of the triangles around each vertex, and the mean length of their edges at it."""
    areas = np.linalg.norm(mesh.face_normals(), axis=1) / 6.0
    area, length, count = np.zeros((3, len(mesh.vertices)))
    for k in range(3):
        here, following = mesh.faces[:, k], mesh.faces[:, (k + 1) % 3]
        edge = np.linalg.norm(mesh.vertices[here] - mesh.vertices[following], axis=1)
        np.add.at(area, here, areas)
        for end in (here, following):
            np.add.at(length, end, edge)
            np.add.at(count, end, 1.0)
    return area, length / np.maximum(count, 1.0)


def _fitted(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colors: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]],
    eyes: Float[np.ndarray, "c 3"],
) -> Float[np.ndarray, "n 9 3"]:
    """Ridge regression on the colours from all cameras, weighted by how squarely they face the surface."""
    normal_matrix = np.zeros((len(points), NUM_SH, NUM_SH))
    right_side = np.zeros((len(points), NUM_SH, 3))
    total = np.zeros(len(points))
    for eye in eyes:
        ahead = points - eye
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        weight = np.maximum(-np.sum(ahead * normals, axis=1), 0.0) + 1e-3
        basis = sh_basis(ahead)
        weighted = weight[:, None] * basis
        normal_matrix += weighted[:, :, None] * basis[:, None, :]
        right_side += weighted[:, :, None] * (colors(ahead)[:, None, :] - 0.5)
        total += weight
    ridge = np.full(NUM_SH, RIDGE)
    ridge[0] = 1e-6
    normal_matrix += total[:, None, None] * np.diag(ridge) * SH_C0**2
    return np.linalg.solve(normal_matrix, right_side)


def _axes(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations whose third axis is the normal."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    side = np.cross(helper, normals)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.stack([side, np.cross(normals, side), normals], axis=2)
