"""A trained fast field to a coloured mesh, and how well the mesh agrees with the field.

The density says what is solid and what is a floater; the depths that it shows to the photos say where the surface is.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, in_world, surface_depth
from fieldstone.field.base.space import finite_box, grid_from_normalized, normalized_from_grid
from fieldstone.field.grid.field import GridField, field_from_tensors
from fieldstone.field.grid.render import renderer
from fieldstone.geometry.camera import Camera, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.atomic import write_json
from fieldstone.io.files.checkpoint import read_checkpoint
from fieldstone.io.shapes.meshes import write_mesh
from fieldstone.render.camera_paths import up_direction
from fieldstone.render.depth_fusion import fused
from fieldstone.render.meshing import cleaned, colored, solidity, surface
from fieldstone.render.rasterize_numba import mesh_depth
from fieldstone.render.views import render_view
from fieldstone.run.fields import CHECKPOINT, frame_from_header, split_tensors
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.rays import rays_from_view

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

COMPARED_VIEWS, COMPARED_SIZE_PX = 8, 200
"""How many photos' views, at which size, the mesh is compared with its field in."""

MESH = "mesh.json"


def mesh_run(
    out: Path,
    *,
    fmt: str = "ply",
    cells: int | None = None,
    level: float = 0.5,
    threads: int | None = None,
    on_stage: Callable[[str], None] = lambda stage: None,
) -> dict[str, Any]:
    """Write `out`/mesh.FMT from the fast field that training left in `out`, and `out`/mesh.json about it.

    Args:
        fmt: ply, obj or glb.
        cells: Grid cells along the longest side; None: as the field, at most `MAX_CELLS`.
        level: Share of the light that matter must stop to count as solid.

    Returns:
        What `mesh.json` holds: sizes, floaters removed, and the agreement with the field in views of the photos.

    Raises:
        InputError: No fast field in `out`, or nothing solid in it.
    """
    field, frame, poses, header = solid_field(out, "a mesh", cells, level)
    on_stage("extracting the surface")
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as executor:
        render_rays = in_world(renderer(field, frame, executor), frame)
        mesh, floaters = normalized_mesh(field, frame, poses, header, render_rays, cells, level)
        world = frame.normalized_from_world.inverse()
        mesh = Mesh(world.apply(mesh.vertices), mesh.faces, mesh.colors)
        path = out / f"mesh.{fmt}"
        write_mesh(_upright(mesh, poses) if fmt == "glb" else mesh, path)
        on_stage("comparing it with the field")
        record = {
            "path": path.name,
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "floaters_removed": floaters,
            "closed": mesh.is_closed(),
            **agreement(mesh, render_rays, header, poses, frame.far / frame.normalized_from_world.scale),
        }
    write_json(out / MESH, record)
    return record


def solid_field(
    out: Path, purpose: str, cells: int | None, level: float
) -> tuple[GridField, FieldFrame, Rigid3, dict[str, Any]]:
    """The fast field that training left in `out`, its frame, the training poses and the checkpoint's facts.

    Args:
        purpose: What it is wanted for, as messages say.
        cells: See `mesh_run`, as level.

    Raises:
        InputError: No fast field in `out`, or cells or level that make no surface.
    """
    if not 0 < level < 1:
        raise InputError(f"--level must lie between 0 and 1, got {level:g}")
    if cells is not None and cells < 2:
        raise InputError(f"--cells must be at least 2, got {cells}")
    tensors, header = read_checkpoint(out / CHECKPOINT)
    if header["field"] != "fast":
        raise InputError(
            f"{out}: {purpose} needs the fast field, not the {header['field']} network; train without --field"
        )
    poses, state = split_tensors(tensors)
    return field_from_tensors(state), frame_from_header(header), poses, header


def normalized_mesh(
    field: GridField,
    frame: FieldFrame,
    poses: Rigid3,
    header: Mapping[str, Any],
    render_rays: RayRenderer,
    cells: int | None,
    level: float,
) -> tuple[Mesh, int]:
    """The coloured mesh of a field in normalised coordinates, and the number of floaters removed.

    Marching cubes runs in the space of the grids; vertices then leave a projective space, where there is one. Of an
    open scene, what lies beyond the box is left out.

    Args:
        render_rays: The field, in the world.
    """
    space = field.space
    lower, upper = finite_box(space, field.occupancy.lower, field.occupancy.lower + field.layout.extent)
    finest = float(field.layout.spacings[-1])
    spacing = max(finest, float(np.max(upper - lower)) / (cells or MAX_CELLS))
    if cells is not None:
        spacing = float(np.max(upper - lower)) / cells
    solid_fraction, floaters = cleaned(solidity(field.density, lower, upper, spacing, LENGTH_CELLS * finest), level)
    world = frame.normalized_from_world.inverse()

    def position(index: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        points = lower + spacing * index
        # The finite part of a contracted space is space as it is.
        return world.apply(normalized_from_grid(space, points) if space.is_projective else points)

    def views() -> Iterator[tuple[Camera, Rigid3, Float[np.ndarray, "h w"]]]:
        for camera, pose in compared_views(header, poses, FUSED_VIEWS, FUSED_SIZE_PX, enlarge=True):
            seen = render_view(render_rays, camera, pose)
            yield camera, pose, surface_depth(seen.depth, seen.opacity, frame.far * world.scale)

    solid_fraction, more = cleaned(fused(solid_fraction, level, position, views()), SURFACE)
    floaters += more
    mesh = surface(solid_fraction, SURFACE, lower, spacing, closed=not space.is_open)
    logger.info("surface of %d faces, %d floaters removed", len(mesh.faces), floaters)
    centers = frame.normalized_from_world.apply(poses.target_origin_in_source())
    if not space.is_projective:
        return colored(mesh, field.color, centers, COLOR_CELLS * finest), floaters

    def color(points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return field.color(np.clip(grid_from_normalized(space, points), lower, upper - 1e-6), directions)

    mesh = Mesh(normalized_from_grid(space, mesh.vertices), mesh.faces)
    return colored(mesh, color, centers, 0.0), floaters


def agreement(
    mesh: Mesh, render_rays: RayRenderer, header: Mapping[str, Any], poses: Rigid3, far: float
) -> dict[str, Any]:
    """Silhouettes (intersection over union) and depths of the mesh against those of the field, in views of photos.

    Args:
        far: Where light that passes ends, in the world.
    """
    overlap, union, depths, views = 0, 0, [], compared_views(header, poses, COMPARED_VIEWS, COMPARED_SIZE_PX)
    for camera, pose in views:
        seen = render_view(render_rays, camera, pose)
        depth = mesh_depth(mesh, camera, pose)
        solid, of_mesh = seen.opacity > 0.5, np.isfinite(depth)
        overlap += int(np.count_nonzero(solid & of_mesh))
        union += int(np.count_nonzero(solid | of_mesh))
        along_z = rays_from_view(camera, pose).directions @ pose.R[2]
        field_depth = surface_depth(seen.depth, seen.opacity, far) * along_z.reshape(depth.shape)
        both = of_mesh & (seen.opacity > 0.95)
        depths.append(np.abs(depth[both] / field_depth[both] - 1.0))
    errors = np.concatenate(depths) if depths else np.empty(0)
    return {
        "silhouette_iou": overlap / max(union, 1),
        "depth_error_median_percent": 100.0 * float(np.median(errors)) if len(errors) else None,
        "compared": f"{len(views)} views of training photos, longer side at most {COMPARED_SIZE_PX} pixels; "
        "silhouette: opacity above 0.5; depth: where opacity is above 0.95",
    }


def compared_views(
    header: Mapping[str, Any], poses: Rigid3, count: int, size_px: int, *, enlarge: bool = False
) -> list[tuple[Camera, Rigid3]]:
    """Cameras at the poses of some training photos, their longer sides at most `size_px`.

    Args:
        enlarge: Exactly `size_px`, also if the photos are smaller.
    """
    found = []
    for v in np.unique(np.linspace(0, len(poses.t) - 1, count).astype(np.int64)).tolist():
        c = header["cameras"][header["camera_of_view"][v]]
        camera = Camera(c["model"], c["width"], c["height"], np.array(c["params"]))
        factor = size_px / max(camera.width, camera.height)
        factor = factor if enlarge else min(factor, 1.0)
        size = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
        found.append((rescale(camera, *size), poses[v]))
    return found


def _upright(mesh: Mesh, poses: Rigid3) -> Mesh:
    """The mesh with y up, as glTF has it, about where photos were held level."""
    up = up_direction(poses)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    R = np.stack([side, up, np.cross(side, up)])
    return Mesh(mesh.vertices @ R.T, mesh.faces, mesh.colors)
