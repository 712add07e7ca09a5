"""A trained grid field to Gaussian splats, and how much they look like the field and the photos."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fieldstone.evaluate.image_metrics import psnr, quantize
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer
from fieldstone.field.base.space import grid_from_normalized
from fieldstone.field.grid.decoder import decode
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.interpolation_numba import interpolate_numba
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.shapes.splats import write_splats
from fieldstone.progress import OnProgress, Progress, silent
from fieldstone.records.shapes import SplatRecord
from fieldstone.rendering.splat_view_numba import splat_view
from fieldstone.rendering.splatting import splats_of_surface
from fieldstone.rendering.views import render_view
from fieldstone.run.options import SurfaceOptions
from fieldstone.run.surface import COLOR_CELLS, normalized_mesh, some_views
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.photos import PosedPhotos
from fieldstone.scene.splats import Splats

logger = logging.getLogger(__name__)

COMPARED_VIEWS, COMPARED_SIZE_PX = 4, 800
"""How many photos' views, at most at which size, the splats are compared with their field in."""


@dataclass(frozen=True, eq=False)
class FieldSplats:
    """Gaussian splats on the surface of a field, in the world of the photos."""

    splats: Splats
    psnr_to_field: float | None
    """Mean over views, in dB; None where no view can be compared."""
    compared: str

    def save(self, path: str | Path) -> None:
        """Write them as the viewers of 3D Gaussian splatting read them (PLY)."""
        write_splats(self.splats, Path(path))

    def record(self, name: str) -> SplatRecord:
        """What `splats.json` tells of them.

        Args:
            name: Of the file that they were saved to.
        """
        return SplatRecord(name, len(self.splats), self.psnr_to_field, self.compared)


def splats_of(
    grid: GridField,
    frame: FieldFrame,
    photos: PosedPhotos,
    render_rays: RayRenderer,
    options: SurfaceOptions,
    on_progress: OnProgress = silent,
) -> FieldSplats:
    """The splats of a field, compared with its views.

    Args:
        photos: Those that the field was learned from.
        render_rays: The field, in the world.

    Raises:
        InputError: Nothing in the field is solid.
    """
    on_progress(Progress("extracting the surface"))
    mesh, floaters = normalized_mesh(grid, frame, photos, render_rays, options)
    splats = splats_of_mesh(mesh, grid, frame, photos.cam_from_world)
    logger.info("%d splats, %d floaters removed", len(splats), floaters)
    on_progress(Progress("comparing them with the field"))
    return FieldSplats(splats, *likeness(splats, frame, photos, render_rays))


def likeness(
    splats: Splats, frame: FieldFrame, photos: PosedPhotos, render_rays: RayRenderer
) -> tuple[float | None, str]:
    """Mean PSNR of views of the splats against those of the field, and which views they are."""
    found, about = [], "no view without lens distortion to compare with"
    for camera, pose in some_views(photos, COMPARED_VIEWS, COMPARED_SIZE_PX):
        if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
            continue
        seen = quantize(splat_view(splats, camera, pose, frame.background).astype(np.float32))
        shown = quantize(render_view(render_rays, camera, pose).rgb)
        found.append(psnr(seen.astype(np.float32) / 255, shown.astype(np.float32) / 255))
        about = (
            f"{len(found)} views of training photos, {camera.width} pixels wide, "
            "blended as 3D Gaussian splatting does, over the background of the field"
        )
    return (float(np.mean(found)) if found else None), about


def splats_of_mesh(mesh: Mesh, field: GridField, frame: FieldFrame, poses: Rigid3) -> Splats:
    """The splats of the surface of a field, in the world of the photos.

    Args:
        mesh: The surface, in normalised coordinates.
    """
    world = frame.normalized_from_world
    back = world.inverse()
    finest = float(field.layout.spacings[-1])
    mesh = Mesh(back.apply(mesh.vertices), mesh.faces)
    grid = field.layout.arrays(field.table)
    upper = field.layout.extent - 1e-6

    def colors_from(points: Float[np.ndarray, "n 3"]) -> Callable[[np.ndarray], np.ndarray]:
        inside = world.apply(points)
        if field.space.is_projective:
            inside = grid_from_normalized(field.space, inside)
        local = np.clip(inside - field.occupancy.lower, 0.0, upper)
        features = interpolate_numba(grid, np.ascontiguousarray(local, dtype=np.float32)).astype(np.float64)
        return lambda directions: decode(field.decoder, features, directions @ world.R.T)

    depth = 0.0 if field.space.is_projective else COLOR_CELLS * finest / world.scale
    return splats_of_surface(mesh, colors_from, poses.target_origin_in_source(), depth)
