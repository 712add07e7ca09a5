"""How far models are from a known truth: rotations, positions, focal lengths, photos that are plainly right or wrong.

Everything is independent of the frame of the model. With world_ref_from_world = R_ref^T R for every photo, the angle
between those of two photos is the error of their relative rotation: a model is right where all of them agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.evaluate.reconstruction_metrics import relative_pose_errors
from fieldstone.geometry.camera import Camera, image_from_plane, plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, nearest_rotation
from fieldstone.scene.alignment import align, common_poses
from fieldstone.scene.reconstruction import Reconstruction

RIGHT_DEG, WRONG_DEG = 10.0, 30.0
"""A photo is right within the first angle of loose truth, and wrong beyond the second."""


@dataclass(frozen=True)
class TruthErrors:
    """Of one model; None where the truth or the number of photos does not tell."""

    photos: int
    """In the model and in the truth."""
    rotation_deg: float | None = None
    """The largest error of a relative rotation, over all pairs of photos."""
    rotation_mean_deg: float | None = None
    """Mean over the photos, after the common rotation that most of them agree with."""
    position_mean: float | None = None
    """In units of the truth, after a similarity."""
    position_share: float | None = None
    """The largest, as a share of the extent of the true positions."""
    focal_percent: float | None = None
    """The largest error of a focal length, sqrt(fx fy), where the truth has cameras."""
    corner_px: float | None = None
    """How far the corners of a photo move from its true camera to the one found; the largest, pixels of the photo."""


@dataclass(frozen=True)
class LooseCounts:
    """Photos whose rotation is plainly right or wrong."""

    right_largest: int
    wrong_largest: int
    right_all: int
    """In all models, each aligned on its own; a model of one photo is right by nothing."""
    wrong_all: int


def truth_errors(model: Reconstruction, truth: Reconstruction, *, cameras: bool = True) -> TruthErrors:
    """Errors of one model.

    Args:
        cameras: Whether the cameras of the truth are worth a comparison.
    """
    poses, true_poses, names = common_poses(model, truth)
    n = len(names)
    focal, corner = camera_errors(model, truth, names) if cameras and n else (None, None)
    if n < 2:
        return TruthErrors(n, focal_percent=focal, corner_px=corner)
    between, aligned = rotation_errors(poses, true_poses)
    mean = share = None
    if n > 2:
        distance = align(model, truth).position_error
        centers = true_poses.target_origin_in_source()
        extent = float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())
        mean, share = float(distance.mean()), float(distance.max()) / extent
    else:  # two photos have a direction only
        relative, true_relative = (p[1:] @ p[:1].inverse() for p in (poses, true_poses))
        share = float(np.sin(min(relative_pose_errors(relative, true_relative)[0], np.pi / 2)))
    return TruthErrors(
        n, float(np.rad2deg(between.max())), float(np.rad2deg(aligned.mean())), mean, share, focal, corner
    )


def rotation_errors(
    cam_from_world: Rigid3, cam_from_reference: Rigid3
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Errors of all relative rotations, and of every rotation after the one that most photos agree with; radians."""
    reference_from_world = np.swapaxes(cam_from_reference.R, 1, 2) @ cam_from_world.R
    n = len(reference_from_world)
    i, j = np.indices((n, n)).reshape(2, -1)
    between = angle_between(reference_from_world[i], reference_from_world[j]).reshape(n, n)
    # The photo that most agree with, then the mean of those: one wrong photo does not turn the others.
    near = between <= np.deg2rad(RIGHT_DEG)
    middle = np.lexsort((np.where(near, between, 0.0).sum(axis=1), -near.sum(axis=1)))[0]
    mean = nearest_rotation(reference_from_world[near[middle]].sum(axis=0))
    return between, angle_between(np.repeat(mean[None], n, axis=0), reference_from_world)


def loose_counts(models: Sequence[Reconstruction], truth: Reconstruction) -> LooseCounts:
    """Photos within 10 and beyond 30 degrees of loose truth, in the largest model and in all of them."""
    counts = []
    for model in models:
        poses, true_poses, names = common_poses(model, truth)
        if len(names) < 2:
            counts.append((0, 0))
            continue
        error_deg = np.rad2deg(rotation_errors(poses, true_poses)[1])
        counts.append((int((error_deg <= RIGHT_DEG).sum()), int((error_deg > WRONG_DEG).sum())))
    right, wrong = zip(*(counts or [(0, 0)]), strict=True)
    return LooseCounts(right[0], wrong[0], sum(right), sum(wrong))


def camera_errors(model: Reconstruction, truth: Reconstruction, names: Sequence[str]) -> tuple[float, float]:
    """Largest error of a focal length in percent and of a corner of a photo in pixels, over the named photos."""
    found = {view.name: model.cameras[view.camera] for view in model.views}
    true = {view.name: truth.cameras[view.camera] for view in truth.views}
    pairs = {(id(found[name]), id(true[name])): (found[name], true[name]) for name in names}
    errors = [camera_error(*pair) for pair in pairs.values()]
    return max(focal for focal, _ in errors), max(corner for _, corner in errors)


def camera_error(found: Camera, true: Camera) -> tuple[float, float]:
    """Error of sqrt(fx fy) in percent, and the largest distance in pixels of a corner seen through both cameras.

    A small rotation of the camera is as good as a principal point that is moved: the direction of the middle is
    taken as given.
    """
    scale = found.width / true.width
    focal, true_focal = (float(np.sqrt(np.prod(camera.focal))) for camera in (found, true))
    box = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [0.5, 0.5]])
    pixels = box * [found.width, found.height]
    seen = image_from_plane(true, plane_from_image(found, pixels)) * scale
    moved = seen - pixels
    moved -= moved[-1]
    return 100.0 * abs(focal / (true_focal * scale) - 1.0), float(np.linalg.norm(moved, axis=1).max())
