"""A trained fast field to Gaussian splats, and how much they look like the field and the photos."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fieldstone.evaluate.image_metrics import psnr, quantize
from fieldstone.field.base.radiance_field import FieldFrame, in_world
from fieldstone.field.base.space import grid_from_normalized
from fieldstone.field.grid.decoder import decode
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.interpolation_numba import interpolate_numba
from fieldstone.field.grid.render import renderer
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.atomic import write_json
from fieldstone.io.shapes.splats import write_splats
from fieldstone.render.splat_view_numba import splat_view
from fieldstone.render.splatting import splats_of_surface
from fieldstone.render.views import render_view
from fieldstone.run.mesh import COLOR_CELLS, compared_views, normalized_mesh, solid_field
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.splats import Splats

logger = logging.getLogger(__name__)

COMPARED_VIEWS, COMPARED_SIZE_PX = 4, 800
"""How many photos' views, at most at which size, the splats are compared with their field in."""

SPLATS, RECORD = "splats.ply", "splats.json"


def splat_run(
    out: Path,
    *,
    cells: int | None = None,
    level: float = 0.5,
    threads: int | None = None,
    on_stage: Callable[[str], None] = lambda stage: None,
) -> dict[str, Any]:
    """Write `out`/splats.ply from the fast field that training left in `out`, and `out`/splats.json about it.

    Args:
        cells: Grid cells along the longest side; None: as the field, at most 320.
        level: Share of the light that matter must stop to count as solid.

    Returns:
        What `splats.json` holds: how many there are, and the PSNR of their views against those of the field.

    Raises:
        InputError: No fast field in `out`, or nothing solid in it.
    """
    field, frame, poses, header = solid_field(out, "a file of splats", cells, level)
    on_stage("extracting the surface")
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as executor:
        render_rays = in_world(renderer(field, frame, executor), frame)
        mesh, floaters = normalized_mesh(field, frame, poses, header, render_rays, cells, level)
        splats = splats_of_mesh(mesh, field, frame, poses)
        logger.info("%d splats, %d floaters removed", len(splats), floaters)
        write_splats(splats, out / SPLATS)
        on_stage("comparing it with the field")
        found, about = [], "no view without lens distortion to compare with"
        for camera, pose in compared_views(header, poses, COMPARED_VIEWS, COMPARED_SIZE_PX):
            if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
                continue
            seen = quantize(splat_view(splats, camera, pose, frame.background).astype(np.float32))
            shown = quantize(render_view(render_rays, camera, pose).rgb)
            found.append(psnr(seen.astype(np.float32) / 255, shown.astype(np.float32) / 255))
            about = (
                f"{len(found)} views of training photos, {camera.width} pixels wide, "
                "blended as 3D Gaussian splatting does, over the background of the field"
            )
    record = {
        "path": SPLATS,
        "splats": len(splats),
        "psnr_to_field": float(np.mean(found)) if found else None,
        "compared": about,
    }
    write_json(out / RECORD, record)
    return record


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
