"""Triangulation of tracks that may hold false observations: every pair of rays proposes, all observations vote.

Compiled; `triangulate_track.py_func` is the readable form. Coordinates are on the plane z = 1, and focal lengths turn
distances on it into pixels, so the error is that of the ideal camera: distortion only bends it a little.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from fieldstone.geometry.rigid3 import Rigid3

MAX_PAIRS = 64
"""Proposals of one track; longer tracks take pairs in a fixed order of decreasing distance in the track."""
REFINEMENTS = 3


def triangulate_robust(
    cam_from_world: Rigid3,
    focal: Float[np.ndarray, "v"],
    view: Int[np.ndarray, "o"],
    uv: Float[np.ndarray, "o 2"],
    starts: Int[np.ndarray, "p_and_one"],
    *,
    max_error_px: float,
    min_angle: float,
) -> tuple[Float[np.ndarray, "p 3"], Bool[np.ndarray, "o"]]:
    """The point that most observations of each track agree on, and which do.

    Two rays that meet at more than `min_angle` propose their midpoint; the proposal with the smallest truncated
    squared error over the whole track wins and is refined by Gauss-Newton on its inliers.

    Args:
        cam_from_world: Poses, batch v.
        focal: Mean focal length of each view in pixels; divided by a view's pixel scale where `max_error_px` is to
            mean so many pixels of that view.
        view, uv: View and ideal coordinates of every observation, tracks one after the other.
        starts: Track p holds the observations starts[p] to starts[p + 1].
        min_angle: Radians; the inliers of an accepted point hold two rays that meet at this angle at least.

    Returns:
        Points, nan where no two observations agree, and the inlier mask over all observations.

    Source:
        `schonberger2016`, section 4.3, with all pairs instead of samples; midpoint `hartley2004`, section 12.2.
    """
    xyz = np.full((len(starts) - 1, 3), np.nan)
    inliers = np.zeros(len(view), dtype=np.bool_)
    _triangulate_tracks(
        np.ascontiguousarray(cam_from_world.R),
        np.ascontiguousarray(cam_from_world.t),
        np.ascontiguousarray(focal, dtype=np.float64),
        np.ascontiguousarray(view, dtype=np.int64),
        np.ascontiguousarray(uv),
        np.ascontiguousarray(starts, dtype=np.int64),
        float(max_error_px) ** 2,
        float(np.cos(min_angle)),
        xyz,
        inliers,
    )
    return xyz, inliers


@njit(cache=True, nogil=True)
@no_type_check
def _triangulate_tracks(R, t, focal, view, uv, starts, max_error2, max_cos, xyz, inliers):
    for p in range(len(starts) - 1):
        a, b = starts[p], starts[p + 1]
        triangulate_track(R, t, focal, view[a:b], uv[a:b], max_error2, max_cos, xyz[p], inliers[a:b])


@njit(cache=True, nogil=True)
@no_type_check
def triangulate_track(R, t, focal, view, uv, max_error2, max_cos, point, inliers):
    """One track; writes `point` (3,) and `inliers` (n,)."""
    n = len(view)
    origins, rays = np.empty((n, 3)), np.empty((n, 3))
    for k in range(n):
        Rk, tk = R[view[k]], t[view[k]]
        norm = np.sqrt(uv[k, 0] ** 2 + uv[k, 1] ** 2 + 1.0)
        for i in range(3):
            rays[k, i] = (Rk[0, i] * uv[k, 0] + Rk[1, i] * uv[k, 1] + Rk[2, i]) / norm
            origins[k, i] = -(Rk[0, i] * tk[0] + Rk[1, i] * tk[1] + Rk[2, i] * tk[2])

    best_score, tried = n * max_error2 * (1.0 - 1e-12), 0
    best, proposal = np.empty(3), np.empty(3)
    found = False
    for gap in range(n - 1, 0, -1):
        for a in range(n - gap):
            if tried >= MAX_PAIRS:
                break
            if not _midpoint(origins[a], rays[a], origins[a + gap], rays[a + gap], max_cos, proposal):
                continue
            tried += 1
            score = _score(R, t, focal, view, uv, proposal, max_error2)
            if score < best_score:
                best_score, found = score, True
                best[:] = proposal
    if not found:
        return
    for _ in range(REFINEMENTS):
        proposal[:] = best
        if not _gauss_newton(R, t, focal, view, uv, proposal, max_error2):
            break
        score = _score(R, t, focal, view, uv, proposal, max_error2)
        if not score < best_score:
            break
        best_score = score
        best[:] = proposal
    if _mark_inliers(R, t, focal, view, uv, best, max_error2, max_cos, origins, inliers):
        point[:] = best


@njit(cache=True, nogil=True)
@no_type_check
def _midpoint(origin1, ray1, origin2, ray2, max_cos, out):
    """Midpoint of the shortest segment between two rays; False if they are too parallel or meet behind a camera."""
    cos = ray1[0] * ray2[0] + ray1[1] * ray2[1] + ray1[2] * ray2[2]
    det = 1.0 - cos * cos
    if cos > max_cos or det <= 0.0:
        return False
    bx, by, bz = origin2[0] - origin1[0], origin2[1] - origin1[1], origin2[2] - origin1[2]
    along1 = bx * ray1[0] + by * ray1[1] + bz * ray1[2]
    along2 = bx * ray2[0] + by * ray2[1] + bz * ray2[2]
    s1 = (along1 - cos * along2) / det
    s2 = (cos * along1 - along2) / det
    if s1 <= 0.0 or s2 <= 0.0:
        return False
    for i in range(3):
        out[i] = 0.5 * (origin1[i] + s1 * ray1[i] + origin2[i] + s2 * ray2[i])
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _error2(R, t, focal, v, u0, u1, X):
    """Squared reprojection error in pixels; inf behind the camera."""
    Rv, tv = R[v], t[v]
    z = Rv[2, 0] * X[0] + Rv[2, 1] * X[1] + Rv[2, 2] * X[2] + tv[2]
    if z <= 0.0:
        return np.inf
    x = (Rv[0, 0] * X[0] + Rv[0, 1] * X[1] + Rv[0, 2] * X[2] + tv[0]) / z - u0
    y = (Rv[1, 0] * X[0] + Rv[1, 1] * X[1] + Rv[1, 2] * X[2] + tv[1]) / z - u1
    return focal[v] * focal[v] * (x * x + y * y)


@njit(cache=True, nogil=True)
@no_type_check
def _score(R, t, focal, view, uv, X, max_error2):
    total = 0.0
    for k in range(len(view)):
        total += min(_error2(R, t, focal, view[k], uv[k, 0], uv[k, 1], X), max_error2)
    return total


@njit(cache=True, nogil=True)
@no_type_check
def _gauss_newton(R, t, focal, view, uv, X, max_error2):
    """One step on the observations within the threshold; False if the normal equations are singular."""
    A, g = np.zeros((3, 3)), np.zeros(3)
    J = np.empty((2, 3))
    for k in range(len(view)):
        v = view[k]
        if _error2(R, t, focal, v, uv[k, 0], uv[k, 1], X) > max_error2:
            continue
        Rv, tv = R[v], t[v]
        z = Rv[2, 0] * X[0] + Rv[2, 1] * X[1] + Rv[2, 2] * X[2] + tv[2]
        for i in range(2):
            p = (Rv[i, 0] * X[0] + Rv[i, 1] * X[1] + Rv[i, 2] * X[2] + tv[i]) / z
            r = focal[v] * (p - uv[k, i])
            for j in range(3):
                J[i, j] = focal[v] * (Rv[i, j] - p * Rv[2, j]) / z
            for a in range(3):
                g[a] += J[i, a] * r
                for b in range(3):
                    A[a, b] += J[i, a] * J[i, b]
    det = (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )
    if not det > 1e-12 * A[0, 0] * A[1, 1] * A[2, 2]:
        return False
    # Cramer's rule on A step = -g.
    step0 = (
        g[0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (g[1] * A[2, 2] - A[1, 2] * g[2])
        + A[0, 2] * (g[1] * A[2, 1] - A[1, 1] * g[2])
    )
    step1 = (
        A[0, 0] * (g[1] * A[2, 2] - A[1, 2] * g[2])
        - g[0] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * g[2] - g[1] * A[2, 0])
    )
    step2 = (
        A[0, 0] * (A[1, 1] * g[2] - g[1] * A[2, 1])
        - A[0, 1] * (A[1, 0] * g[2] - g[1] * A[2, 0])
        + g[0] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )
    X[0] -= step0 / det
    X[1] -= step1 / det
    X[2] -= step2 / det
    return True


@njit(cache=True, nogil=True)
@no_type_check
def _mark_inliers(R, t, focal, view, uv, X, max_error2, max_cos, origins, inliers):
    """Mark the observations within the threshold; False, and none, if no two of their rays are wide enough."""
    n = len(view)
    for k in range(n):
        inliers[k] = _error2(R, t, focal, view[k], uv[k, 0], uv[k, 1], X) <= max_error2
    for a in range(n):
        if not inliers[a]:
            continue
        for b in range(a + 1, n):
            if inliers[b]:
                dot = na = nb = 0.0
                for i in range(3):
                    da, db = origins[a, i] - X[i], origins[b, i] - X[i]
                    dot += da * db
                    na += da * da
                    nb += db * db
                if dot <= max_cos * np.sqrt(na * nb):
                    return True
    inliers[:] = False
    return False
