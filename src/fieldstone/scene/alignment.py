"""Two reconstructions of one scene brought into one frame and compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, nearest_rotation
from fieldstone.geometry.sim3 import Sim3, fit_sim3
from fieldstone.scene.reconstruction import Reconstruction


@dataclass(frozen=True, eq=False)
class PoseComparison:
    """Differences of the poses of the views (by name) that both reconstructions registered, after alignment."""

    names: tuple[str, ...]
    reference_from_model: Sim3
    position_error: Float[np.ndarray, "v"]
    """Distances between camera centres, in units of the reference."""
    rotation_error: Float[np.ndarray, "v"]
    """Radians."""


def align(model: Reconstruction, reference: Reconstruction) -> PoseComparison:
    """The Sim3 that moves the camera centres of `model` onto those of `reference`, and what differs after it.

    With two views, or centres on a line, the centres leave a rotation free: the rotation then comes from the mean
    relative camera rotation instead.

    Raises:
        ValueError: Fewer than two views are registered in both.
    """
    poses_model, poses_reference, names = common_poses(model, reference)
    if len(names) < 2:
        raise ValueError(f"alignment needs two common registered views, got {len(names)}")
    centers_model = poses_model.target_origin_in_source()
    centers_reference = poses_reference.target_origin_in_source()
    reference_from_model = fit_sim3(centers_model, centers_reference)
    spread = np.linalg.svd(centers_model - centers_model.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        R = nearest_rotation(np.sum(np.swapaxes(poses_reference.R, 1, 2) @ poses_model.R, axis=0))
        t = centers_reference.mean(axis=0) - reference_from_model.scale * R @ centers_model.mean(axis=0)
        reference_from_model = Sim3(reference_from_model.scale, R, t)
    moved = reference_from_model.move_pose(poses_model)
    position_error = np.linalg.norm(moved.target_origin_in_source() - centers_reference, axis=1)
    return PoseComparison(names, reference_from_model, position_error, angle_between(moved.R, poses_reference.R))


def common_poses(a: Reconstruction, b: Reconstruction) -> tuple[Rigid3, Rigid3, tuple[str, ...]]:
    """Poses of the views that are registered in both, matched by name, in the order of `a`."""
    poses_b = {v.name: v.cam_from_world for v in b.views if v.cam_from_world is not None}
    both = [
        (v.name, v.cam_from_world, poses_b[v.name])
        for v in a.views
        if v.cam_from_world is not None and v.name in poses_b
    ]
    return (
        Rigid3.stack([pose for _, pose, _ in both]),
        Rigid3.stack([pose for _, _, pose in both]),
        tuple(name for name, _, _ in both),
    )


def transformed(model: Reconstruction, b_from_a: Sim3) -> Reconstruction:
    """The same reconstruction in another world frame."""
    views = tuple(
        replace(v, cam_from_world=None if v.cam_from_world is None else b_from_a.move_pose(v.cam_from_world))
        for v in model.views
    )
    return replace(model, views=views, points=replace(model.points, xyz=b_from_a.apply(model.points.xyz)))
