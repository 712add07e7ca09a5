"""A density to a clean mesh: marching cubes, hidden holes filled, and what floats about left out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from skimage.measure import marching_cubes

from fieldstone.errors import InputError
from fieldstone.scene.mesh import Mesh

Density = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]

POINTS_AT_ONCE = 1 << 18

MIN_PART = 0.01
"""Parts of the solid with less than this share of the volume of the largest one are taken for floaters."""


def solidity(
    density: Density, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], spacing: float, length: float
) -> Float[np.ndarray, "x y z"]:
    """1 - exp(-density length), the share of light that a length of the matter stops, at the points of a grid.

    Args:
        spacing: Between the points, the first at `lower`; the last ones reach `upper`.
    """
    shape = np.maximum(np.ceil((upper - lower) / spacing - 1e-6).astype(np.int64), 1) + 1
    out = np.empty(int(np.prod(shape)), dtype=np.float32)
    for start in range(0, len(out), POINTS_AT_ONCE):
        rows = np.arange(start, min(start + POINTS_AT_ONCE, len(out)))
        points = lower + spacing * np.stack(np.unravel_index(rows, tuple(shape)), axis=1)
        out[rows] = -np.expm1(-density(points) * length)
    return out.reshape(tuple(shape.tolist()))


def cleaned(
    solid_fraction: Float[np.ndarray, "x y z"], level: float, min_part: float = MIN_PART
) -> tuple[Float[np.ndarray, "x y z"], int]:
    """The grid without floaters and without holes that nobody can see into; also how many floaters there were.

    A part is what hangs together across faces. A hole is a part of the empty space that does not reach the border of
    the grid: light never came there, so a field says nothing about it.
    """
    parts, count = _parts(solid_fraction >= level)
    if count == 0:
        raise InputError("the field is nowhere dense enough for a surface; train it longer, or ask for a lower `level`")
    sizes = np.bincount(parts.reshape(-1), minlength=count + 1)[1:]
    floating = np.append(False, sizes < min_part * sizes.max())
    solid_fraction = np.where(floating[parts], 0.0, solid_fraction)
    holes, _ = _parts(np.pad(solid_fraction < level, 1, constant_values=True))
    inner = (holes != holes[0, 0, 0]) & (holes > 0)
    return np.where(inner[1:-1, 1:-1, 1:-1], 1.0, solid_fraction).astype(np.float32), int(np.count_nonzero(floating))


def surface(
    solid_fraction: Float[np.ndarray, "x y z"],
    level: float,
    lower: Float[np.ndarray, "3"],
    spacing: float,
    *,
    closed: bool,
) -> Mesh:
    """The surface on which the solid fraction has a value, in the frame of `lower`.

    Args:
        closed: Where matter reaches the border of the grid, the surface follows the border; else it ends there.

    Source:
        `lorensen1987`, in the variant of scikit-image.
    """
    padded = np.pad(solid_fraction, 1)
    vertices, faces, _, _ = marching_cubes(padded, level, gradient_direction="ascent", allow_degenerate=False)
    if not closed:
        inside = np.all((vertices >= 1.0) & (vertices <= np.array(solid_fraction.shape)), axis=1)
        faces = faces[inside[faces].all(axis=1)]
        used = np.unique(faces)
        faces, vertices = np.searchsorted(used, faces), vertices[used]
    return Mesh(lower + spacing * (vertices.astype(np.float64) - 1.0), faces.astype(np.int64))


def colored(
    mesh: Mesh,
    color: Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]],
    centers: Float[np.ndarray, "c 3"],
    depth: float,
) -> Mesh:
    """The mesh with the colours that the field shows to the camera that looks at each vertex most squarely.

    Args:
        color: Colours in [0, 1] at points, seen along unit directions.
        centers: Of the cameras, in the frame of the mesh.
        depth: How far behind the surface colours are taken: on it, half of the neighbours are empty.
    """
    normals = mesh.vertex_normals()
    colors = np.empty((len(mesh.vertices), 3), dtype=np.uint8)
    for start in range(0, len(colors), POINTS_AT_ONCE):
        rows = slice(start, start + POINTS_AT_ONCE)
        points, n = mesh.vertices[rows], normals[rows]
        best = np.full(len(points), -2.0)
        directions = np.zeros_like(points)
        for center in centers:
            ahead = points - center
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
            facing = -np.sum(ahead * n, axis=1)
            better = facing > best
            best[better], directions[better] = facing[better], ahead[better]
        colors[rows] = _eight_bit(color(points - depth * n, directions))
    return Mesh(mesh.vertices, mesh.faces, colors)


def _parts(mask: Bool[np.ndarray, "x y z"]) -> tuple[Int[np.ndarray, "x y z"], int]:
    """Numbers from 1 of what hangs together across faces, 0 elsewhere, and how many there are."""
    parts = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=parts)
    return parts, int(parts.max(initial=0))


def _eight_bit(rgb: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    return np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
