"""A triangle mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles over shared vertices, counter-clockwise seen from outside; colours are sRGB, one a vertex."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colors: UInt8[np.ndarray, "v 3"] | None = None

    def face_normals(self) -> Float[np.ndarray, "f 3"]:
        """Not unit: the length is twice the area of the face."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    def vertex_normals(self) -> Float[np.ndarray, "v 3"]:
        """Unit means of the normals of the faces around each vertex, weighted by area; 0 without any."""
        normals = np.zeros_like(self.vertices)
        of_faces = self.face_normals()
        for k in range(3):
            np.add.at(normals, self.faces[:, k], of_faces)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(lengths > 0, lengths, 1.0)

    def volume(self) -> float:
        """Enclosed volume, if the mesh is closed: a sixth of the sum of a . (b x c)."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.sum(a * np.cross(b, c))) / 6.0

    def is_closed(self) -> bool:
        """Every edge has a face on either side, which run along it in opposite directions."""
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        key = edges[:, 0] * len(self.vertices) + edges[:, 1]
        back = edges[:, 1] * len(self.vertices) + edges[:, 0]
        return len(np.unique(key)) == len(key) and np.array_equal(np.sort(key), np.sort(back))
