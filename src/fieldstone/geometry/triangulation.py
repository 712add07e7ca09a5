"""Triangulation from known poses: linear (DLT) for any number of views, midpoint, angles, cheirality."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.epipolar import homogeneous
from fieldstone.geometry.rigid3 import Rigid3


def triangulate_linear(cam_from_world: Rigid3, uv: Float[np.ndarray, "*p v 2"]) -> Float[np.ndarray, "*p 3"]:
    """Points seen in v views by the direct linear transform: the null vector of the rows u P3 - P1, v P3 - P2.

    Rows are scaled to unit length, so that views at different distances weigh alike. A point at infinity (parallel
    rays) comes out as inf or very large; check angles and cheirality before use.

    Args:
        cam_from_world: Poses, batch v.
        uv: Ideal coordinates on the plane z = 1 of each point in each view.

    Source:
        `hartley2004`, section 12.2.
    """
    P = np.concatenate([cam_from_world.R, cam_from_world.t[:, :, None]], axis=2)
    rows = uv[..., None] * P[:, None, 2, :] - P[:, :2, :]
    rows = rows / np.linalg.norm(rows, axis=-1, keepdims=True)
    A = rows.reshape(*uv.shape[:-2], -1, 4)
    X = np.linalg.svd(A)[2][..., -1, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        return X[..., :3] / X[..., 3:]


def triangulate_tracks_linear(
    cam_from_world: Rigid3,
    view: Int[np.ndarray, "o"],
    point: Int[np.ndarray, "o"],
    uv: Float[np.ndarray, "o 2"],
    num_points: int,
) -> Float[np.ndarray, "num_points 3"]:
    """`triangulate_linear` for tracks of different lengths: observation k sees `point[k]` in `view[k]` at `uv[k]`.

    Tracks of one length are solved together. nan for points with fewer than two observations.
    """
    out = np.full((num_points, 3), np.nan)
    order = np.argsort(point, kind="stable")
    lengths = np.bincount(point, minlength=num_points)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    for length in np.unique(lengths[lengths >= 2]):
        members = np.flatnonzero(lengths == length)
        rows = order[starts[members][:, None] + np.arange(length)]
        P = np.concatenate([cam_from_world.R, cam_from_world.t[:, :, None]], axis=2)[view[rows]]
        A = uv[rows][..., None] * P[..., None, 2, :] - P[..., :2, :]
        A = A / np.linalg.norm(A, axis=-1, keepdims=True)
        X = np.linalg.svd(A.reshape(len(members), 2 * length, 4))[2][:, -1, :]
        with np.errstate(divide="ignore", invalid="ignore"):
            out[members] = X[:, :3] / X[:, 3:]
    return out


def triangulate_midpoint(
    centers: Float[np.ndarray, "v 3"], directions: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "3"]:
    """The point nearest to v rays in the least-squares sense: sum (I - d d^T) x = sum (I - d d^T) c.

    Args:
        centers: Where each ray starts.
        directions: Unit vectors, in the same frame.

    Raises:
        numpy.linalg.LinAlgError: All rays are parallel.

    Source:
        `hartley2004`, chapter 12 (the midpoint method), for any number of rays.
    """
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.linalg.solve(projectors.sum(axis=0), np.einsum("vij,vj->i", projectors, centers))


def depths(cam_from_world: Rigid3, points_in_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """z of each point in the camera frame; one pose, or one per point."""
    return cam_from_world.apply(points_in_world)[..., 2]


def triangulation_angles(
    center1: Float[np.ndarray, "*n 3"],
    center2: Float[np.ndarray, "*n 3"],
    points_in_world: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n"]:
    """Angle in [0, pi] at each point between the rays to two camera centres (one centre, or one per point)."""
    a, b = center1 - points_in_world, center2 - points_in_world
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def in_front_of_both(cam2_from_cam1: Rigid3, points_in_cam1: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Cheirality: the point is finite and has positive depth in both cameras."""
    with np.errstate(invalid="ignore"):
        return (
            np.all(np.isfinite(points_in_cam1), axis=1)
            & (points_in_cam1[:, 2] > 0)
            & (depths(cam2_from_cam1, points_in_cam1) > 0)
        )


def choose_by_cheirality(
    candidates: list[Rigid3], uv1: Float[np.ndarray, "n 2"], uv2: Float[np.ndarray, "n 2"]
) -> tuple[int, Int[np.ndarray, "c"]]:
    """Index of the candidate pose that puts most points in front of both cameras, and the count of each.

    Args:
        candidates: `cam2_from_cam1`, usually the four of `epipolar.poses_from_essential`.
        uv1, uv2: Matches on the plane z = 1.

    Source:
        `hartley2004`, section 9.6.3.
    """
    counts = []
    for cam2_from_cam1 in candidates:
        poses = Rigid3.stack([Rigid3.identity(), cam2_from_cam1])
        points = triangulate_linear(poses, np.stack([uv1, uv2], axis=1))
        counts.append(int(in_front_of_both(cam2_from_cam1, points).sum()))
    return int(np.argmax(counts)), np.array(counts)


def bearings(uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Unit directions of coordinates on the plane z = 1."""
    x = homogeneous(uv)
    return x / np.linalg.norm(x, axis=1, keepdims=True)
