"""Views of a field: one image of colour, depth and opacity for a camera and a pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.field.base.radiance_field import RayRenderer, surface_depth
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.rays import Rays, rays_from_view

RAYS_AT_ONCE = 1 << 16

SAME_SIDE = 0.5
"""Cosine of the angle up to which a photo sees the same side of a surface as a view."""


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Colour in [0, 1] (sRGB), depth along the ray in world units, opacity in [0, 1]; float32.

    All are 0 at pixels that no ray of the camera reaches (outside of a wide lens).
    """

    rgb: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    opacity: Float[np.ndarray, "h w"]


def depth_image(view: RenderedView, near: float, far: float) -> Float[np.ndarray, "h w 3"]:
    """Grey values that are linear in 1 / depth, from 1 at `near` to 0 at `far`; black where little is seen."""
    inverse = 1.0 / np.maximum(view.depth, 1e-12)
    grey = np.clip((inverse - 1.0 / far) / (1.0 / near - 1.0 / far), 0.0, 1.0)
    return np.repeat(np.where(view.opacity > 0.5, grey, 0.0)[:, :, None], 3, axis=2)


def normal_image(view: RenderedView, camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """(n + 1) / 2 of the normals of the surface that the depth describes; black where little is seen.

    Normals are in the camera frame with OpenGL axes (x right, y up, z to the camera), from central differences of the
    points that neighbouring pixels see; n points to the camera.
    """
    rays = rays_from_view(camera, Rigid3(np.eye(3), np.zeros(3)))
    points = rays.directions.reshape(*view.depth.shape, 3) * view.depth[:, :, None]
    with np.errstate(invalid="ignore"):
        normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)
    facing = np.sum(normals * points, axis=2, keepdims=True)
    normals = np.where(facing > 0, -normals, normals) * [1.0, -1.0, -1.0]
    num_photos = (view.opacity > 0.5)[:, :, None] & np.isfinite(normals)
    return np.where(num_photos, 0.5 + 0.5 * normals, 0.0)


def confidence_image(
    view: RenderedView, camera: Camera, cam_from_world: Rigid3, photos: Sequence[tuple[Camera, Rigid3]], far: float
) -> Float[np.ndarray, "h w 3"]:
    """How well the photos determine what each pixel shows: opacity times 1 - 2^(1 - n), 0 for n = 0.

    n is the number of photos that have the point in their picture and look at it from within 60 degrees of the view:
    one alone leaves the depth open, every further one halves the doubt. Whether something hides the point from a
    photo is not asked.

    Args:
        photos: Camera and `cam_from_world` of each.
        far: Where light that passes ends in `RenderedView.depth`.
    """
    rays = rays_from_view(camera, cam_from_world)
    depth = surface_depth(view.depth, view.opacity, far, least=1e-3).reshape(-1, 1)
    points = rays.origins + rays.directions * np.where(np.isfinite(depth), depth, np.nan)
    num_photos = np.zeros(len(points), dtype=np.int64)
    for photo, pose in photos:
        in_cam = pose.apply(points)
        towards = points - pose.target_origin_in_source()
        length = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
        aligned = np.sum(towards * rays.directions, axis=1) > SAME_SIDE * length
        candidate = np.flatnonzero(aligned & (in_cam[:, 2] > 0) & np.isfinite(in_cam).all(axis=1))
        pixels = image_from_cam(photo, in_cam[candidate])
        inside = np.all((pixels >= 0) & (pixels < [photo.width, photo.height]), axis=1)
        num_photos[candidate[inside]] += 1
    confidence = np.where(num_photos > 0, 1.0 - 0.5 ** np.maximum(num_photos - 1.0, 0.0), 0.0).reshape(
        view.opacity.shape
    )
    return np.repeat((confidence * view.opacity)[:, :, None], 3, axis=2)


def render_view(
    render_rays: RayRenderer, camera: Camera, cam_from_world: Rigid3, *, rays_at_once: int = RAYS_AT_ONCE
) -> RenderedView:
    """What the camera sees, with `render_rays` for rays in the world."""
    (view,) = progressive_views(render_rays, camera, cam_from_world, strides=(1,), rays_at_once=rays_at_once)
    return view


def progressive_views(
    render_rays: RayRenderer,
    camera: Camera,
    cam_from_world: Rigid3,
    *,
    strides: Sequence[int] = (8, 4, 2, 1),
    rays_at_once: int = RAYS_AT_ONCE,
) -> Iterator[RenderedView]:
    """What the camera sees, sharper and sharper, for who moves through a scene and does not wait for all pixels.

    Every view has the full size. With stride s, one pixel stands for s x s; those of earlier strides are not rendered
    again, so that all views together cost what the last one costs, and a view that is no longer wanted costs nothing.

    Args:
        strides: Falling; the last one is 1 for the view of `render_view`.
    """
    rays = rays_from_view(camera, cam_from_world)
    shape = (camera.height, camera.width)
    missing = np.all(np.isfinite(rays.directions), axis=1)
    rgb = np.zeros((len(rays), 3), dtype=np.float32)
    depth = np.zeros(len(rays), dtype=np.float32)
    opacity = np.zeros(len(rays), dtype=np.float32)
    for stride in strides:
        row, column = (np.minimum(np.arange(n) // stride * stride + stride // 2, n - 1) for n in shape)
        shown = row[:, None] * camera.width + column
        requested = missing.copy()
        if stride > 1:
            requested[:] = False
            requested[shown] = missing[shown]
        requested = np.flatnonzero(requested)
        for start in range(0, len(requested), rays_at_once):
            rows = requested[start : start + rays_at_once]
            rendered = render_rays(Rays(rays.origins[rows], rays.directions[rows], rays.pixel_radius[rows]))
            rgb[rows], depth[rows], opacity[rows] = rendered.rgb, rendered.depth, rendered.opacity
        missing[requested] = False
        if stride > 1:
            yield RenderedView(rgb[shown], depth[shown], opacity[shown])
        else:
            yield RenderedView(rgb.reshape(*shape, 3), depth.reshape(shape), opacity.reshape(shape))
