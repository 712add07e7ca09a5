"""Depth of a triangle mesh in a camera, by a depth buffer: what a mesh is compared with its field by."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.mesh import Mesh


def mesh_depth(mesh: Mesh, camera: Camera, cam_from_world: Rigid3) -> Float[np.ndarray, "h w"]:
    """Depth along z at the centre of each pixel, inf where there is no triangle.

    Edges stay straight between projected vertices, which is exact without distortion and good for small triangles.
    Triangles that reach behind the camera are left out.
    """
    in_cam = cam_from_world.apply(mesh.vertices)
    pixels = image_from_cam(camera, in_cam)
    out = np.full((camera.height, camera.width), np.inf)
    _fill(np.ascontiguousarray(pixels), np.ascontiguousarray(in_cam[:, 2]), np.ascontiguousarray(mesh.faces), out)
    return out


@njit(cache=True, nogil=True)
@no_type_check
def _fill(pixels, depth, faces, out):  # (v, 2), (v,), (f, 3), (h, w)
    """Keep the smallest depth of all triangles: 1 / z is linear in the image."""
    height, width = out.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if not (depth[a] > 0 and depth[b] > 0 and depth[c] > 0):
            continue
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        if not np.isfinite(ax + ay + bx + by + cx + cy):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        x0 = int(max(np.ceil(min(ax, bx, cx) - 0.5), 0))
        x1 = int(min(np.floor(max(ax, bx, cx) - 0.5), width - 1))
        y0 = int(max(np.ceil(min(ay, by, cy) - 0.5), 0))
        y1 = int(min(np.floor(max(ay, by, cy) - 0.5), height - 1))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                px, py = x + 0.5, y + 0.5
                u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area
                v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area
                w = 1.0 - u - v
                if u >= 0 and v >= 0 and w >= 0:
                    z = 1.0 / (u / depth[a] + v / depth[b] + w / depth[c])
                    out[y, x] = min(out[y, x], z)
