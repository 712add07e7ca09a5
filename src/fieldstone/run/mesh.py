"""A trained grid field to a coloured mesh, and how well the mesh agrees with the field."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, surface_depth
from fieldstone.field.grid.field import GridField
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.shapes.meshes import write_mesh
from fieldstone.progress import OnProgress, Progress, silent
from fieldstone.records.shapes import MeshRecord
from fieldstone.rendering.camera_paths import up_direction
from fieldstone.rendering.rasterize_numba import mesh_depth
from fieldstone.rendering.views import render_view
from fieldstone.run.options import SurfaceOptions
from fieldstone.run.surface import normalized_mesh, some_views
from fieldstone.scene.mesh import Mesh
from fieldstone.scene.photos import PosedPhotos
from fieldstone.scene.rays import rays_from_view

COMPARED_VIEWS, COMPARED_SIZE_PX = 8, 200
"""How many photos' views, at which size, the mesh is compared with its field in."""


@dataclass(frozen=True)
class Agreement:
    """How well a mesh and its field agree in views of training photos."""

    silhouette_iou: float
    depth_error_median_percent: float | None
    compared: str


@dataclass(frozen=True, eq=False)
class FieldMesh:
    """The surface of a field, in the world of the photos."""

    mesh: Mesh
    floaters_removed: int
    agreement: Agreement
    cam_from_world: Rigid3
    """Poses of the training photos: they say where up is."""

    def save(self, path: str | Path) -> None:
        """Write PLY or OBJ in the world of the photos, or GLB with y up.

        Raises:
            InputError: Another suffix, or a path that cannot be written.
        """
        target = Path(path)
        write_mesh(_upright(self.mesh, self.cam_from_world) if target.suffix == ".glb" else self.mesh, target)

    def record(self, name: str) -> MeshRecord:
        """What `mesh.json` tells of it.

        Args:
            name: Of the file that it was saved to.
        """
        return MeshRecord(
            path=name,
            vertices=len(self.mesh.vertices),
            faces=len(self.mesh.faces),
            floaters_removed=self.floaters_removed,
            closed=self.mesh.is_closed(),
            **asdict(self.agreement),
        )


def mesh_of(
    grid: GridField,
    frame: FieldFrame,
    photos: PosedPhotos,
    render_rays: RayRenderer,
    options: SurfaceOptions,
    on_progress: OnProgress = silent,
) -> FieldMesh:
    """The coloured mesh of a field, without what floats about, compared with the field.

    Args:
        photos: Those that the field was learned from.
        render_rays: The field, in the world.

    Raises:
        InputError: Nothing in the field is solid.
    """
    on_progress(Progress("extracting the surface"))
    mesh, floaters = normalized_mesh(grid, frame, photos, render_rays, options)
    world_from_normalized = frame.normalized_from_world.inverse()
    mesh = Mesh(world_from_normalized.apply(mesh.vertices), mesh.faces, mesh.colors)
    on_progress(Progress("comparing it with the field"))
    found = agreement(mesh, render_rays, photos, frame.far * world_from_normalized.scale)
    return FieldMesh(mesh, floaters, found, photos.cam_from_world)


def agreement(mesh: Mesh, render_rays: RayRenderer, photos: PosedPhotos, far: float) -> Agreement:
    """Silhouettes (intersection over union) and depths of the mesh against those of the field, in views of photos.

    Args:
        far: Where light that passes ends, in the world.
    """
    overlap, union, depths, views = 0, 0, [], some_views(photos, COMPARED_VIEWS, COMPARED_SIZE_PX)
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
    return Agreement(
        silhouette_iou=overlap / max(union, 1),
        depth_error_median_percent=100.0 * float(np.median(errors)) if len(errors) else None,
        compared=f"{len(views)} views of training photos, longer side at most {COMPARED_SIZE_PX} pixels; "
        "silhouette: opacity above 0.5; depth: where opacity is above 0.95",
    )


def _upright(mesh: Mesh, poses: Rigid3) -> Mesh:
    """The mesh with y up, as glTF has it, about where photos were held level."""
    up = up_direction(poses)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    R = np.stack([side, up, np.cross(side, up)])
    return Mesh(mesh.vertices @ R.T, mesh.faces, mesh.colors)
