"""Densities whose optical depth along any ray is known in closed form: the oracle of everything that renders volumes.

Each has a density sigma(x) and `optical_depth`, the integral of sigma along o + t d from t0 to t1, |d| = 1. The light
that passes is exp(-optical depth).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import erf


@dataclass(frozen=True, eq=False)
class Slab:
    """Constant density between the planes normal . x = lower and normal . x = upper."""

    sigma: float
    normal: Float[np.ndarray, "3"]
    lower: float
    upper: float

    def density(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """sigma inside, 0 outside."""
        height = points @ self.normal
        return np.where((height >= self.lower) & (height <= self.upper), self.sigma, 0.0)

    def optical_depth(
        self, origins: Float[np.ndarray, "r 3"], directions: Float[np.ndarray, "r 3"], t0: float, t1: float
    ) -> Float[np.ndarray, "r"]:
        """sigma times the length inside of the slab: the part of [t0, t1] between the crossings of its planes."""
        height, slope = origins @ self.normal, directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings = (np.array([[self.lower], [self.upper]]) - height) / slope
        inside = (height >= self.lower) & (height <= self.upper)
        # A ray along the slab is inside all the way or not at all.
        enter = np.where(slope == 0.0, np.where(inside, -np.inf, np.inf), np.minimum(*crossings))
        leave = np.where(slope == 0.0, np.inf, np.maximum(*crossings))
        return self.sigma * np.maximum(np.minimum(leave, t1) - np.maximum(enter, t0), 0.0)


@dataclass(frozen=True, eq=False)
class Ball:
    """Constant density inside of a sphere."""

    sigma: float
    center: Float[np.ndarray, "3"]
    radius: float

    def density(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """sigma inside, 0 outside."""
        return np.where(np.linalg.norm(points - self.center, axis=-1) <= self.radius, self.sigma, 0.0)

    def optical_depth(
        self, origins: Float[np.ndarray, "r 3"], directions: Float[np.ndarray, "r 3"], t0: float, t1: float
    ) -> Float[np.ndarray, "r"]:
        """sigma times the part of [t0, t1] on the chord, of half length sqrt(radius^2 - distance to the centre^2)."""
        t_nearest, squared_distance = _nearest(origins, directions, self.center)
        half_chord = np.sqrt(np.maximum(self.radius**2 - squared_distance, 0.0))
        chord = np.minimum(t_nearest + half_chord, t1) - np.maximum(t_nearest - half_chord, t0)
        return self.sigma * np.maximum(chord, 0.0)


@dataclass(frozen=True, eq=False)
class GaussianBlob:
    """sigma exp(-|x - center|^2 / (2 width^2))."""

    sigma: float
    center: Float[np.ndarray, "3"]
    width: float

    def density(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """sigma at the centre, falling off as a Gaussian."""
        squared_distance = np.sum((points - self.center) ** 2, axis=-1)
        return self.sigma * np.exp(-0.5 * squared_distance / self.width**2)

    def optical_depth(
        self, origins: Float[np.ndarray, "r 3"], directions: Float[np.ndarray, "r 3"], t0: float, t1: float
    ) -> Float[np.ndarray, "r"]:
        """A Gaussian along the ray: its peak times width sqrt(pi / 2) (erf(b) - erf(a))."""
        t_nearest, squared_distance = _nearest(origins, directions, self.center)
        peak = self.sigma * np.exp(-0.5 * squared_distance / self.width**2)
        a, b = ((t - t_nearest) / (np.sqrt(2.0) * self.width) for t in (t0, t1))
        return peak * self.width * np.sqrt(0.5 * np.pi) * (erf(b) - erf(a))


def _nearest(
    origins: Float[np.ndarray, "r 3"], directions: Float[np.ndarray, "r 3"], center: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "r"], Float[np.ndarray, "r"]]:
    """Where each ray passes nearest to the centre, and its squared distance from it there."""
    to_center = center - origins
    t = np.sum(to_center * directions, axis=1)
    return t, np.maximum(np.sum(to_center**2, axis=1) - t**2, 0.0)
