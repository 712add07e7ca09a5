"""A pose from relative poses alone, for a photo that matches registered ones but sees none of their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, nearest_rotation
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import MatchGraph

MAX_ANGLE = np.deg2rad(5.0)
"""Partners whose rotation or direction is further off do not agree."""
MIN_SPREAD = np.sin(np.deg2rad(3.0)) ** 2
"""Directions to the partners that span less fix no distance."""
ROUNDS = 5


@dataclass(frozen=True, eq=False)
class _Partners:
    """Registered photos with a pose relative to them: what each says of the new photo."""

    R: Float[np.ndarray, "k 3 3"]
    """World to the new photo."""
    centers: Float[np.ndarray, "k 3"]
    """Of the partners."""
    directions: Float[np.ndarray, "k 3"]
    """From the partner to the new photo, in the world."""
    weights: Float[np.ndarray, "k"]


def pose_from_partners(model: WorkingModel, graph: MatchGraph, view: int, min_inliers: int) -> Rigid3 | None:
    """`cam_from_world` that most registered partners agree on; None without two whose directions cross.

    The rotation is the mean of those that agree with the one that agrees with most; the centre is the point nearest to
    the lines from the partners, in angles, reweighted.

    Source:
        The last resort of `schonberger2016`'s registration by structure, without the structure.
    """
    partners = _partners(model, graph, view, min_inliers)
    if partners is None:
        return None
    k = len(partners.R)
    R1, R2 = np.repeat(partners.R, k, axis=0), np.tile(partners.R, (k, 1, 1))
    agree = (angle_between(R1, R2) < MAX_ANGLE).reshape(k, k)
    best = agree[int(np.argmax(agree @ partners.weights))]
    if best.sum() < 2:
        return None
    R = nearest_rotation(np.einsum("k,kij->ij", partners.weights[best], partners.R[best]))
    center = _crossing(partners.centers[best], partners.directions[best], partners.weights[best])
    return None if center is None else Rigid3(R, -R @ center)


def _partners(model: WorkingModel, graph: MatchGraph, view: int, min_inliers: int) -> _Partners | None:
    rows = []
    for (i, j), two_view in sorted(graph.two_views.items()):
        if view not in (i, j) or two_view.kind != "calibrated" or two_view.cam2_from_cam1 is None:
            continue
        partner, inliers = (j if view == i else i), int(two_view.inliers.sum())
        if not model.registered[partner] or inliers < min_inliers:
            continue
        view_from_partner = two_view.cam2_from_cam1 if view == j else two_view.cam2_from_cam1.inverse()
        pose = model.pose_of(partner)
        direction = pose.R.T @ view_from_partner.target_origin_in_source()
        center = pose.target_origin_in_source()
        rows.append((view_from_partner.R @ pose.R, center, direction / np.linalg.norm(direction), float(inliers)))
    if len(rows) < 2:
        return None
    return _Partners(*(np.array(column) for column in zip(*rows, strict=True)))


def _crossing(
    centers: Float[np.ndarray, "k 3"], directions: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "3"] | None:
    """The point ahead on most of the lines; None if they are all but parallel or do not cross."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = weights / weights.sum()
    trust, point, off = weights, np.zeros(3), np.zeros(len(weights))
    for _ in range(ROUNDS):
        A = np.einsum("k,kij->ij", trust, across)
        if np.linalg.eigvalsh(A)[0] < MIN_SPREAD * np.trace(A) / 2:
            return None
        point = np.linalg.solve(A, np.einsum("k,kij,kj->i", trust, across, centers))
        offset = point - centers
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-300)
        off = np.linalg.norm(np.einsum("kij,kj->ki", across, offset), axis=1) / distance
        trust = weights * (MAX_ANGLE**2 / (MAX_ANGLE**2 + off**2)) ** 2 / distance**2
        trust = trust / trust.sum()
    ahead = np.sum((point - centers) * directions, axis=1) > 0
    return point if np.sum(ahead & (off < MAX_ANGLE)) >= 2 else None
