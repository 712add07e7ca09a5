"""How good a reconstruction is: pose errors against a reference, AUC over pairs, reprojection errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between
from fieldstone.scene.alignment import common_poses
from fieldstone.scene.reconstruction import Reconstruction


def pairwise_pose_errors_deg(model: Reconstruction, reference: Reconstruction) -> Float[np.ndarray, "p"]:
    """Larger of relative rotation and translation-direction error, for all pairs of the reference's photos.

    inf for pairs of which a photo is not registered in the model. No alignment enters: relative poses have no gauge.

    Source:
        The protocol of `jin2021`, section 3.
    """
    posed_model, posed_reference, _ = common_poses(model, reference)
    n, total = len(posed_model.t), len(reference.registered())
    i, j = np.triu_indices(n, 1)
    errors = np.full(total * (total - 1) // 2, np.inf)
    errors[: len(i)] = np.rad2deg(
        relative_pose_errors(
            posed_model[j] @ posed_model[i].inverse(), posed_reference[j] @ posed_reference[i].inverse()
        )
    )
    return errors


def relative_pose_errors(estimate: Rigid3, truth: Rigid3) -> Float[np.ndarray, "p"]:
    """max(angle between the rotations, angle between the translation directions) in radians, of batches.

    A true translation of length 0 has no direction: only the rotation counts.
    """
    norms = np.linalg.norm(estimate.t, axis=1), np.linalg.norm(truth.t, axis=1)
    a, b = (T.t / np.where(n > 0, n, 1.0)[:, None] for T, n in zip((estimate, truth), norms, strict=True))
    between = 2.0 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return np.maximum(angle_between(estimate.R, truth.R), np.where(norms[1] > 0, between, 0.0))


def area_under_curve(errors: Float[np.ndarray, "n"], thresholds: Sequence[float]) -> list[float]:
    """For each threshold the mean recall over errors in [0, threshold], in percent: 100 means no error at all.

    The recall curve is a staircase, so its area is exact: mean of max(0, 1 - error / threshold).
    """
    if not len(errors):
        return [float("nan")] * len(thresholds)
    return [100.0 * float(np.mean(np.maximum(0.0, 1.0 - errors / threshold))) for threshold in thresholds]
