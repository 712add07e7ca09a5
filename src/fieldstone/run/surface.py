"""The surface of a trained grid field, where its photos see it.

The density says what is solid and what is a floater; the depths that it shows to the photos say where the surface is.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, surface_depth
from fieldstone.field.base.space import finite_box, grid_from_normalized, normalized_from_grid
from fieldstone.field.grid.field import GridField
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.rendering.depth_fusion import fused
from fieldstone.rendering.meshing import cleaned, colored, solidity, surface
from fieldstone.rendering.views import render_view
from fieldstone.run.options import SurfaceOptions
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.photos import PosedPhotos

logger = logging.getLogger(__name__)

MAX_CELLS = 320
"""Grid points along the longest side, unless asked for: more than the eye sees in most viewers."""

LENGTH_CELLS = 2.0
"""The light that this many cells of the finest level stop decides what is solid."""

FUSED_VIEWS, FUSED_SIZE_PX = 48, 400
"""How many photos' views, at which size, say where the surface lies."""

SURFACE = 0.5
"""Value on the surface of `depth_fusion.fused`."""

COLOR_CELLS = 0.25
"""How far behind the surface colours are taken, in cells of the finest level: before it there is nothing."""


def normalized_mesh(
    field: GridField, frame: FieldFrame, photos: PosedPhotos, render_rays: RayRenderer, options: SurfaceOptions
) -> tuple[Mesh, int]:
    """The coloured mesh of a field in normalised coordinates, and the number of floaters removed.

    Marching cubes runs in the space of the grids; vertices then leave a projective space, where there is one. Of an
    open scene, what lies beyond the box is left out.

    Args:
        photos: Those that say where the surface lies, at their poses in the world.
        render_rays: The field, in the world.

    Raises:
        InputError: Nothing in the field is solid.
    """
    space = field.space
    lower, upper = finite_box(space, field.occupancy.lower, field.occupancy.lower + field.layout.extent)
    finest = float(field.layout.spacings[-1])
    spacing = max(finest, float(np.max(upper - lower)) / (options.cells or MAX_CELLS))
    if options.cells is not None:
        spacing = float(np.max(upper - lower)) / options.cells
    solid_fraction = solidity(field.density, lower, upper, spacing, LENGTH_CELLS * finest)
    solid_fraction, floaters = cleaned(solid_fraction, options.level)
    world = frame.normalized_from_world.inverse()

    def position(index: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        points = lower + spacing * index
        # The finite part of a contracted space is space as it is.
        return world.apply(normalized_from_grid(space, points) if space.is_projective else points)

    def views() -> Iterator[tuple[Camera, Rigid3, Float[np.ndarray, "h w"]]]:
        for camera, pose in some_views(photos, FUSED_VIEWS, FUSED_SIZE_PX, enlarge=True):
            seen = render_view(render_rays, camera, pose)
            yield camera, pose, surface_depth(seen.depth, seen.opacity, frame.far * world.scale)

    solid_fraction, more = cleaned(fused(solid_fraction, options.level, position, views()), SURFACE)
    floaters += more
    mesh = surface(solid_fraction, SURFACE, lower, spacing, closed=not space.is_open)
    logger.info("surface of %d faces, %d floaters removed", len(mesh.faces), floaters)
    centers = frame.normalized_from_world.apply(photos.centers())
    if not space.is_projective:
        return colored(mesh, field.color, centers, COLOR_CELLS * finest), floaters

    def color(points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return field.color(np.clip(grid_from_normalized(space, points), lower, upper - 1e-6), directions)

    mesh = Mesh(normalized_from_grid(space, mesh.vertices), mesh.faces)
    return colored(mesh, color, centers, 0.0), floaters


def some_views(photos: PosedPhotos, count: int, size_px: int, *, enlarge: bool = False) -> list[tuple[Camera, Rigid3]]:
    """Cameras and poses of some of the photos, their longer sides at most `size_px`.

    Args:
        enlarge: Exactly `size_px`, also if the photos are smaller.
    """
    found = []
    for v in np.unique(np.linspace(0, len(photos) - 1, count).astype(np.int64)).tolist():
        camera = photos.camera_of(v)
        factor = size_px / max(camera.width, camera.height)
        factor = factor if enlarge else min(factor, 1.0)
        size = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
        found.append((rescale(camera, *size), photos.pose_of(v)))
    return found
