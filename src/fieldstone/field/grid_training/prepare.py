"""Posed photos and triangulated points to a training of the grid field: space, occupancy and rays of the start."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
from jaxtyping import Float

from fieldstone.errors import InputError
from fieldstone.field.base.projection import projection_for
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import NORMALIZED_RADIUS, SeenPoints
from fieldstone.field.base.space import Space, box_space, contracted_space, grid_from_normalized, projective_space
from fieldstone.field.evidence.free_space import carve_free_space, free_distances
from fieldstone.field.evidence.options import DEFAULT_EVIDENCE, EvidenceOptions
from fieldstone.field.evidence.pose_refinement import refinable_poses
from fieldstone.field.evidence.sparse_depth import no_sparse_depth_rays, sparse_depth_rays
from fieldstone.field.grid.field import occupancy_box
from fieldstone.field.grid.occupancy import Occupancy, full_box, visual_hull
from fieldstone.field.grid.rays import ray_table
from fieldstone.field.grid_training.plan import GridPlan
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.photos import DecodedPhotos, PosedPhotos

logger = logging.getLogger(__name__)

HULL_CELLS = 96
"""Cells of the visual hull along the longest side of the box."""

OPEN_CELLS = 64
"""Cells of an open space along the longest side, before training."""


def prepare_grid_training(
    photos: DecodedPhotos,
    frame: FieldFrame,
    plan: GridPlan,
    *,
    seed: int,
    executor: Executor,
    use_alpha: bool = True,
    points_in_world: Float[np.ndarray, "p 3"] | None = None,
    seen: Sequence[SeenPoints | None] = (),
    bounded: bool = True,
    refine_poses: bool = False,
    evidence: EvidenceOptions = DEFAULT_EVIDENCE,
) -> GridTraining:
    """The training of a grid field on posed photos.

    The box is `NORMALIZED_RADIUS` around the origin of the frame. Where photos have alpha, it shrinks to the visual
    hull. An open scene whose photos look the same way gets a projective space; in others everything beyond the box is
    contracted into a shell around it.

    Args:
        points_in_world: Triangulated points, which tell how near things are.
        seen: Those that each photo observes; empty: nothing is known of any.
        bounded: Nothing lies beyond the box.
        use_alpha: False takes photos with alpha as photos on the background of the frame.
        evidence: How far photos and points are believed.
        refine_poses: Keep what a plan with `refine_poses` needs.

    Raises:
        InputError: No ray meets the scene.
    """
    points = np.empty((0, 3)) if points_in_world is None else points_in_world
    space, bounds = space_of(photos.posed, frame, points, bounded=bounded)
    occupancy = full_box(bounds[0], bounds[1] - bounds[0], HULL_CELLS // 2 if bounded else OPEN_CELLS)
    alpha_known = use_alpha and photos.have_alpha
    if alpha_known and bounded:
        occupancy = _hull(occupancy, photos, frame, executor)
    depth_rays, sparse_depths = no_sparse_depth_rays()
    free_distance_of = None
    if seen:
        occupancy = carve_free_space(occupancy, photos.posed, frame, seen, space, executor, evidence.free_space)
        logger.info("seen to be free: %.1f %% of the box", 100 * (1 - occupancy.cells.mean()))
        depth_rays, sparse_depths = sparse_depth_rays(photos, frame, seen, space)
        free_distance_of = (
            None if space.is_projective else free_distances(photos.posed, frame, seen, evidence.free_space)
        )
    box = occupancy_box(occupancy, occupancy.extent, space)
    return GridTraining(
        rays=ray_table(photos, frame, box, executor, use_alpha=use_alpha, free_distance_of=free_distance_of),
        depth_rays=depth_rays,
        sparse_depths=sparse_depths,
        frame=frame,
        occupancy=occupancy,
        space=space,
        plan=plan,
        seed=seed,
        executor=executor,
        points_in_grid=grid_from_normalized(space, frame.normalized_from_world.apply(points)),
        alpha_known=alpha_known,
        floaters=evidence.floaters,
        refinable=refinable_poses(photos, frame, seen, evidence.poses) if refine_poses else None,
    )


def space_of(
    photos: PosedPhotos, frame: FieldFrame, points_in_world: Float[np.ndarray, "p 3"], *, bounded: bool
) -> tuple[Space, Float[np.ndarray, "2 3"]]:
    """The space that suits a scene, and the lower and upper corner of its grid."""
    cube = NORMALIZED_RADIUS * np.array([[-1.0] * 3, [1.0] * 3])
    if bounded:
        return box_space(), cube
    projected = projection_for(photos, frame, points_in_world)
    if projected is None:
        return contracted_space(), 2.0 * cube
    projection, bounds = projected
    return projective_space(projection), bounds


def _hull(box: Occupancy, photos: DecodedPhotos, frame: FieldFrame, executor: Executor) -> Occupancy:
    """The visual hull of photos with alpha.

    Raises:
        InputError: It is empty.
    """
    masks = [pixels[:, :, 3] > 0 for pixels in photos.pixels]
    if not any(mask.any() for mask in masks):
        raise InputError("all photos are fully transparent: their alpha is 0 everywhere; train without alpha")
    poses = [_cam_from_normalized(photos.posed.pose_of(v), frame) for v in range(len(photos))]
    cameras = [photos.posed.camera_of(v) for v in range(len(photos))]
    occupancy = visual_hull(box, masks, cameras, poses, HULL_CELLS, executor).trimmed()
    logger.info("visual hull: %.1f %% of a box of %s", 100 * occupancy.cells.mean(), occupancy.extent.round(3))
    if not occupancy.cells.any():
        raise InputError(
            "the alpha masks leave nothing: no point lies on opaque pixels in all photos that show it; check that "
            "alpha is 255 on the object and that the poses belong to the photos, or train without alpha"
        )
    return occupancy


def _cam_from_normalized(cam_from_world: Rigid3, frame: FieldFrame) -> Rigid3:
    """Pose of a camera in the frame; lengths are those of the frame."""
    world = frame.normalized_from_world
    R = cam_from_world.R @ world.R.T
    return Rigid3(R, -R @ world.apply(cam_from_world.target_origin_in_source()))
