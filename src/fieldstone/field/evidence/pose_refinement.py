"""Poses of photos, moved so that a field shows what the photos show, and held by the points that are known.

A small motion of a camera moves its picture by a flow that follows from the depth. The picture that the field gives,
shifted so, is compared with the photo: one Gauss-Newton step for six numbers of each photo. The known points of a
reconstruction say how well they determine the pose, in pixels; moving away from it costs what it costs them.

Source:
    `lucas1981` with the motion of a rigid scene; the term that holds the poses is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, minimum_filter

from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, RenderedRays, surface_depth
from fieldstone.field.base.ray_dataset import SeenPoints, reduce_photos
from fieldstone.field.evidence.options import DEFAULT_EVIDENCE, PoseOptions
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.jacobian import image_from_world_jacobian
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.photos import DecodedPhotos
from fieldstone.scene.rays import Rays, rays_from_view


@dataclass(frozen=True, eq=False)
class RefinablePoses:
    """Small photos at the poses that they were given, and what holds them there."""

    photos: DecodedPhotos
    information: Float[np.ndarray, "v 6 6"]
    """What the known points say of each pose: the inverse covariance of a tangent (omega, v), see `Rigid3.retract`."""
    options: PoseOptions = DEFAULT_EVIDENCE.poses


def refinable_poses(
    photos: DecodedPhotos,
    frame: FieldFrame,
    seen: Sequence[SeenPoints | None],
    options: PoseOptions = DEFAULT_EVIDENCE.poses,
) -> RefinablePoses:
    """The photos as they are compared, and what holds them.

    Args:
        seen: Known points of each photo, in the world; empty: nothing is known of any.
    """
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    middle = frame.normalized_from_world.inverse().apply(corners)
    information = np.empty((len(photos), 6, 6))
    for v in range(len(photos)):
        known = seen[v] if seen else None
        points, sigma_px = middle, options.unknown_sigma_px
        if known is not None and len(known.xyz) >= options.min_points:
            points, sigma_px = known.xyz, options.sigma_px
        J = image_from_world_jacobian(photos.posed.camera_of(v), photos.posed.pose_of(v), points).by_pose
        J = J[np.isfinite(J).all(axis=(1, 2))]
        information[v] = np.einsum("nki,nkj->ij", J, J) / sigma_px**2
    return RefinablePoses(reduce_photos(photos, options.size_px), information, options)


def refined(
    refinable: RefinablePoses,
    pose_deltas: Float[np.ndarray, "v 6"],
    render_rays: RayRenderer,
    gains: Float[np.ndarray, "v 3"],
    background: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "v 6"]:
    """One step for every photo; a step that does not bring the pictures together is not taken.

    Args:
        pose_deltas: Tangents from the given poses to those of now.
        render_rays: Of the field, for rays in the world.
        gains: What each photo multiplies colours by.
        background: Behind photos with alpha.

    Returns:
        The tangents after the step.
    """
    out = pose_deltas.copy()
    photos, options = refinable.photos, refinable.options
    for v, information in enumerate(refinable.information):
        target = photos.composited(v, background).reshape(-1, 3)
        here = _compare(photos, v, pose_deltas[v], render_rays, gains[v], target, options)
        step = _step(photos.posed.camera_of(v), information, pose_deltas[v], here, options)
        if step is None:
            continue
        there = _compare(photos, v, pose_deltas[v] + step, render_rays, gains[v], target, options)
        both = here.usable & there.usable
        sigma, after = here.sigma, pose_deltas[v] + step
        if _cost(there, both, sigma, information, after, options) < _cost(
            here, both, sigma, information, pose_deltas[v], options
        ):
            out[v] += step
    return out


def at_surfaces(render_rays: RayRenderer, far: float) -> RayRenderer:
    """The same rays with the distances of what they meet: light that passes does not count as ending at `far`."""

    def render(rays: Rays, /) -> RenderedRays:
        found = render_rays(rays)
        depth = surface_depth(found.depth, found.opacity, far)
        return RenderedRays(found.rgb, np.where(np.isfinite(depth), depth, far).astype(np.float32), found.opacity)

    return render


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A photo beside what the field shows, pixel by pixel."""

    pose: Rigid3
    rendered: RenderedRays
    shown: Float[np.ndarray, "p 3"]
    residual: Float[np.ndarray, "p 3"]
    usable: Bool[np.ndarray, "p"]
    points: Float[np.ndarray, "p 3"]
    min_sigma: float

    @property
    def sigma(self) -> float:
        """Of the residuals; not their median: the few pixels on edges and texture are what tells of the pose."""
        some = self.residual[self.usable]
        return max(float(np.sqrt(np.mean(some**2))) if some.size else 1.0, self.min_sigma)


def _compare(
    photos: DecodedPhotos,
    v: int,
    tangent: np.ndarray,
    render_rays: RayRenderer,
    gain: np.ndarray,
    target: np.ndarray,
    options: PoseOptions,
) -> _Comparison:
    camera, keep = photos.posed.camera_of(v), photos.keep[v]
    pose = photos.posed.pose_of(v).retract(tangent)
    rays = rays_from_view(camera, pose)
    reached = np.flatnonzero(np.isfinite(rays.directions).all(axis=1))
    rendered = _rendered(render_rays, rays, reached)
    shown = rendered.rgb.astype(np.float64) * gain
    usable = _inside_surfaces(camera, rendered, options)
    if keep is not None:
        usable &= keep.reshape(-1)
    points = rays.origins + rays.directions * rendered.depth[:, None]
    return _Comparison(pose, rendered, shown, target - shown, usable, points, options.min_sigma)


def _rendered(render_rays: RayRenderer, rays: Rays, rows: Int[np.ndarray, "k"]) -> RenderedRays:
    """These rays; others, outside of a wide lens, show nothing."""
    found = render_rays(Rays(rays.origins[rows], rays.directions[rows], rays.pixel_radius[rows]))
    rgb, (depth, opacity) = np.zeros((len(rays), 3), np.float32), np.zeros((2, len(rays)), np.float32)
    rgb[rows], depth[rows], opacity[rows] = found.rgb, found.depth, found.opacity
    return RenderedRays(rgb, depth, opacity)


def _inside_surfaces(camera: Camera, rendered: RenderedRays, options: PoseOptions) -> Bool[np.ndarray, "p"]:
    """Pixels that lie on one surface with their neighbours: across an edge the picture does not flow, it is hidden."""
    shape = camera.height, camera.width
    opaque = rendered.opacity.reshape(shape) > options.min_opacity
    depth = np.where(opaque, rendered.depth.reshape(shape).astype(np.float64), np.inf)
    nearest, farthest = minimum_filter(depth, 3, mode="nearest"), maximum_filter(depth, 3, mode="nearest")
    return (farthest < options.max_depth_ratio * nearest).reshape(-1)


def _step(
    camera: Camera, information: np.ndarray, tangent: np.ndarray, here: _Comparison, options: PoseOptions
) -> np.ndarray | None:
    """The minimum of the linearised squares; None where nothing can be compared."""
    grid = here.shown.reshape(camera.height, camera.width, 3)
    if min(grid.shape[:2]) < 3 or not here.usable.any():
        return None
    by_x, by_y = (np.asarray(np.gradient(grid, axis=axis)).reshape(-1, 3) for axis in (1, 0))
    slopes = np.stack([by_x, by_y], axis=2)[here.usable]
    flow = image_from_world_jacobian(camera, here.pose, here.points[here.usable]).by_pose
    # photo(x) - shown(x - flow step) = residual + slope . flow step
    G = np.einsum("pck,pki->pci", slopes, flow).reshape(-1, 6)
    r = here.residual[here.usable].reshape(-1)
    good = np.isfinite(G).all(axis=1)
    G, r = G[good], r[good]
    weight = 1.0 / (1.0 + (r / here.sigma) ** 2) / (options.correlated_pixels * here.sigma**2)
    A = (G * weight[:, None]).T @ G + information
    b = G.T @ (weight * r) + information @ tangent
    try:
        return -np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        return None


def _cost(
    at: _Comparison,
    usable: np.ndarray,
    sigma: float,
    information: np.ndarray,
    tangent: np.ndarray,
    options: PoseOptions,
) -> float:
    """Robust mean of the squared differences, as many as there are, and what the known points pay."""
    r = at.residual[usable] / sigma
    return float(0.5 * np.log1p(r**2).sum() / options.correlated_pixels + 0.5 * tangent @ information @ tangent)
