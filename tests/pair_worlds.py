"""Fundamental matrices of photos whose focal lengths are known to the test."""

from __future__ import annotations

import numpy as np

from fieldstone.geometry.epipolar import essential_from_pose, fundamental_from_essential, homogeneous
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.solve.averaging.focal_lengths import FocalPrior, PairEvidence
from fieldstone.solve.robust.fundamental_covariance import directions, fundamental_covariance, with_rank_two

PIXEL = 1 / 1600


def poses(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Cameras around the origin that look past it, so that no two axes meet."""
    out = []
    for _ in range(count):
        R = exp(0.5 * rng.normal(size=3))
        out.append(Rigid3(R, rng.normal(size=3) + [0.0, 0.0, 6.0]))
    return out


def world(focals, noise: float = 0.0, seed: int = 0) -> PairEvidence:
    """All pairs among photos with these focal lengths; matrices from noisy matches, refined to their least error."""
    rng = np.random.default_rng(seed)
    views, points = poses(len(focals), rng), rng.uniform(-1.5, 1.5, size=(150, 3))
    pairs, F, C = [], [], []
    K = [np.diag([f, f, 1.0]) for f in focals]
    seen = [(cam.apply(points) @ k.T)[:, :2] / cam.apply(points)[:, 2:] for cam, k in zip(views, K, strict=True)]
    for i in range(len(focals)):
        for j in range(i + 1, len(focals)):
            E = essential_from_pose(views[j] @ views[i].inverse())
            exact = with_rank_two(fundamental_from_essential(E, K[i], K[j]))
            x1, x2 = (seen[k] + noise * rng.normal(size=seen[k].shape) for k in (i, j))
            pairs.append((i, j))
            F.append(refined(exact, x1, x2) if noise else exact)
            C.append(fundamental_covariance(F[-1], x1, x2, (PIXEL, PIXEL)))
    return PairEvidence(np.array(pairs), np.array(F), np.array(C))


def refined(F, x1, x2):
    """Gauss-Newton on the Sampson errors of all matches, from close by."""
    for _ in range(5):
        h1, h2 = homogeneous(x1), homogeneous(x2)
        slope = np.sqrt(np.sum((h1 @ F.T)[:, :2] ** 2 + (h2 @ F)[:, :2] ** 2, axis=1))
        tangent = directions(F)
        J = np.einsum("ni,kij,nj->nk", h2, tangent, h1) / slope[:, None]
        e = np.sum(h2 * (h1 @ F.T), axis=1) / slope
        F = with_rank_two(F - np.einsum("k,kij->ij", np.linalg.lstsq(J, e)[0], tangent))
    return F


def nothing_known(count: int) -> FocalPrior:
    return FocalPrior(np.full(count, np.log(1.2)), np.full(count, 0.45), np.full(count, np.nan))
