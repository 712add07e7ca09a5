"""How two models of one scene lie to each other, from photos of the one that see points of the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares

from fieldstone.geometry import rotation
from fieldstone.geometry.sim3 import Sim3

TRIALS = 300
"""Samples of two sightings for every rotation."""
COARSE_FACTOR = 3.0
"""Threshold of the samples over that of the inliers: their rotation is that of one pair of photos."""
REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class Sightings:
    """Sighting k: a photo of one model sees a point of the other, in both directions.

    from_a: the photo is of model a and the point of b, otherwise the other way round.
    in_a, in_b: positions in the frames of a and b: the photo's centre in its own model, the point in the other.
    rays: unit vectors from the photo to the point, in the frame of the photo's model.
    focals: pixels per unit of the tangent of an angle, over the pixel scale of the photo.
    """

    from_a: Bool[np.ndarray, "n"]
    in_a: Float[np.ndarray, "n 3"]
    in_b: Float[np.ndarray, "n 3"]
    rays: Float[np.ndarray, "n 3"]
    focals: Float[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.from_a)

    def normals(self) -> Float[np.ndarray, "n 2 3"]:
        """Two unit vectors across every ray, in the frame of the ray."""
        axis = np.eye(3)[np.argmin(np.abs(self.rays), axis=1)]
        first = np.cross(self.rays, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(self.rays, first)], axis=1)

    def select(self, keep: Bool[np.ndarray, "n"]) -> Sightings:
        """The sightings of a mask."""
        return Sightings(self.from_a[keep], self.in_a[keep], self.in_b[keep], self.rays[keep], self.focals[keep])


@dataclass(frozen=True, eq=False)
class FrameSimilarity:
    """The similarity, and which sightings agree with it."""

    a_from_b: Sim3
    inliers: Bool[np.ndarray, "n"]


def estimate_frame_similarity(
    sightings: Sightings, rotations: Float[np.ndarray, "r 3 3"], max_error_px: float, rng: np.random.Generator
) -> FrameSimilarity | None:
    """The similarity that most sightings agree with, for one of these rotations from b to a, refined.

    With the rotation known, scale and translation are linear in the sightings, and two of them suffice:
    ray x (s R x_b + t - x_a) = 0. The best of random samples then is refined, rotation and all, on what agrees.

    Returns:
        None with fewer than four sightings that agree.

    Source:
        The sampling of `fischler1981` with the score of `torr2000`.
    """
    best, best_cost = None, np.inf
    coarse = COARSE_FACTOR * max_error_px
    for R in rotations if len(sightings) >= 2 else ():
        for candidate in _from_two_sightings(sightings, R, rng):
            cost = float(np.minimum(errors_px(candidate, sightings), coarse).sum())
            if cost < best_cost:
                best, best_cost = candidate, cost
    if best is None:
        return None
    limits = np.geomspace(coarse, max_error_px, REFINEMENTS)
    for limit in limits:
        inliers = errors_px(best, sightings) < limit
        if inliers.sum() < 4:
            return None
        best = _refined(best, sightings.select(inliers), max_error_px)
    return FrameSimilarity(best, errors_px(best, sightings) < max_error_px)


def errors_px(a_from_b: Sim3, sightings: Sightings) -> Float[np.ndarray, "n"]:
    """Distance of every point from where its photo sees it, in pixels; inf behind the camera."""
    across, along = _in_photo(a_from_b, sightings)
    ahead = along > 0
    return np.where(ahead, sightings.focals * np.linalg.norm(across, axis=1) / np.where(ahead, along, 1.0), np.inf)


def _in_photo(a_from_b: Sim3, sightings: Sightings) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """From photo to point, across the ray and along it, in units of a."""
    offset = a_from_b.apply(sightings.in_b) - sightings.in_a  # to the point, if it is one of b
    local = np.where(sightings.from_a[:, None], offset, -offset @ a_from_b.R)
    return np.einsum("nij,nj->ni", sightings.normals(), local), np.sum(sightings.rays * local, axis=1)


def _from_two_sightings(sightings: Sightings, R: Float[np.ndarray, "3 3"], rng: np.random.Generator) -> list[Sim3]:
    """Similarities with a given rotation, each from two sightings that are drawn at random."""
    samples: Int[np.ndarray, "h 2"] = np.stack([rng.choice(len(sightings), 2, replace=False) for _ in range(TRIALS)])
    normals = sightings.normals()
    normals = np.where(sightings.from_a[:, None, None], normals, normals @ R.T)
    scale_column = np.einsum("nij,nj->ni", normals, sightings.in_b @ R.T)
    A = np.concatenate([scale_column[:, :, None], normals], axis=2)[samples].reshape(-1, 4, 4)
    b = np.einsum("nij,nj->ni", normals, sightings.in_a)[samples].reshape(-1, 4)
    solutions = np.einsum("hij,hj->hi", np.linalg.pinv(A), b)
    return [Sim3(float(s), R, np.array(t)) for s, *t in solutions.tolist() if s > 0]


def _refined(start: Sim3, sightings: Sightings, scale_px: float) -> Sim3:
    """The similarity of least (soft L1) error in pixels near a start; sightings behind their photo cost a lot."""
    spread = float(np.linalg.norm(start.apply(sightings.in_b) - sightings.in_a, axis=1).mean())

    def moved(x: Float[np.ndarray, "7"]) -> Sim3:
        return Sim3(start.scale * float(np.exp(x[6])), rotation.exp(x[:3]) @ start.R, start.t + spread * x[3:6])

    def residuals(x: Float[np.ndarray, "7"]) -> Float[np.ndarray, "m"]:
        across, along = _in_photo(moved(x), sightings)
        return (sightings.focals[:, None] * across / np.maximum(along, 1e-3 * spread)[:, None]).ravel()

    return moved(least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=scale_px).x)
