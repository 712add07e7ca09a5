"""Views of a field: one image of colour, depth and opacity for a camera and a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.field.radiance_field import RayRenderer
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.rays import Rays, rays_from_view

RAYS_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Colour in [0, 1] (sRGB), depth along the ray in world units, opacity in [0, 1]; float32.

    All are 0 at pixels that no ray of the camera reaches (outside of a wide lens).
    """

    rgb: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    opacity: Float[np.ndarray, "h w"]


def render_view(render_rays: RayRenderer, camera: Camera, cam_from_world: Rigid3) -> RenderedView:
    """What the camera sees, with `render_rays` for rays in the world."""
    rays = rays_from_view(camera, cam_from_world)
    reached = np.flatnonzero(np.all(np.isfinite(rays.directions), axis=1))
    rgb = np.zeros((len(rays), 3), dtype=np.float32)
    depth = np.zeros(len(rays), dtype=np.float32)
    opacity = np.zeros(len(rays), dtype=np.float32)
    for start in range(0, len(reached), RAYS_AT_ONCE):
        rows = reached[start : start + RAYS_AT_ONCE]
        rendered = render_rays(Rays(rays.origins[rows], rays.directions[rows], rays.pixel_radius[rows]))
        rgb[rows], depth[rows], opacity[rows] = rendered.rgb, rendered.depth, rendered.opacity
    shape = (camera.height, camera.width)
    return RenderedView(rgb.reshape(*shape, 3), depth.reshape(shape), opacity.reshape(shape))
