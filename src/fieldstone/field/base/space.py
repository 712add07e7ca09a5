"""The space that the grids live in: a box, all of space contracted into one, or a projective one.

Three coordinates are told apart. Normalised ones are those of `FieldFrame`. The grid has its own: equal in a box; with
r = max(|x|, |y|, |z|) / h, h the half side of the inner cube, a contracted space puts a point p at

    u = p                          for r <= 1,
    u = (2 - 1 / r) p / r          beyond,

so that everything lies within [-2h, 2h]^3; a projective space is that of `projection`. A ray is marched along the
distance t from where it begins: normalised distance in the first two spaces, distance in the grid in the projective
one, where rays stay straight.

Source:
    `barron2022`, eq. 10. Departure: the largest coordinate in place of the norm, so that a cube is filled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fieldstone.field.base.projection import (
    Projection,
    distance_along,
    no_projection,
    project_points,
    project_rays,
    unproject_points,
)
from fieldstone.field.base.ray_dataset import NORMALIZED_RADIUS

BOX, CONTRACTED, PROJECTIVE = 0, 1, 2

MAX_DEPTH_RATIO = 0.97
"""In a projective space, what lies nearer to infinity is not finite enough to have a surface."""


class Space(NamedTuple):
    """Which space it is, as kernels take it too; made by `box_space`, `contracted_space` and `projective_space`."""

    kind: int
    """BOX, CONTRACTED or PROJECTIVE."""
    half_side: np.float32
    """h: half side of the cube that a contracted space leaves as it is, in normalised units."""
    projection: Projection
    """Of a projective space; in others it has no meaning."""

    @property
    def is_contracted(self) -> bool:
        """Everything beyond the inner cube is contracted into a shell around it."""
        return self.kind == CONTRACTED

    @property
    def is_projective(self) -> bool:
        """Near things get small cells, and infinity is a plane."""
        return self.kind == PROJECTIVE

    @property
    def is_open(self) -> bool:
        """The space reaches to infinity, so that every ray meets it."""
        return self.kind != BOX


def box_space() -> Space:
    """Space as it is."""
    return Space(BOX, np.float32(NORMALIZED_RADIUS), no_projection())


def contracted_space(half_side: float = NORMALIZED_RADIUS) -> Space:
    """All of space, in a box of four times `half_side`."""
    return Space(CONTRACTED, np.float32(half_side), no_projection())


def projective_space(projection: Projection) -> Space:
    """What lies ahead of cameras that look the same way."""
    return Space(PROJECTIVE, np.float32(NORMALIZED_RADIUS), projection)


def grid_from_normalized(space: Space, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Where points lie in the grid; in a projective space, only those ahead of the mean camera lie anywhere."""
    if space.is_projective:
        return project_points(space.projection, points)
    if space.is_contracted:
        reach = np.maximum(_reach(space, points), 1.0)
        return points / reach * (2.0 - 1.0 / reach)
    return points


def normalized_from_grid(space: Space, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The inverse of `grid_from_normalized`; not finite at infinity, and past it on the other side of it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if space.is_projective:
            return unproject_points(space.projection, points)
        if space.is_contracted:
            reach = _reach(space, points)
            return np.where(reach > 1.0, points / (reach * (2.0 - reach)), points)
    return points


def stretch(space: Space, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """How far a ray is marched at points for a unit of length in the grid: r^2 in a contracted space, else 1.

    The largest coordinate of u is 2h - h / r, and its derivative by that of p is 1 / r^2.
    """
    if space.is_contracted:
        return np.maximum(_reach(space, points)[:, 0], 1.0) ** 2
    return np.ones(len(points))


def along_rays(
    space: Space, center: Float[np.ndarray, "3"], points: Float[np.ndarray, "n 3"], sigma: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Where rays from one centre meet points, as rays are marched; nan outside of the space.

    Args:
        sigma: Standard deviations of the distances of the points.

    Returns:
        t, its standard deviation, and the `stretch` there.
    """
    offset = points - center
    distance = np.linalg.norm(offset, axis=1)
    if not space.is_projective:
        return distance, sigma, stretch(space, points)
    projection = space.projection
    directions = offset / distance[:, None]
    depth = (points - projection.center) @ projection.R[2]
    start, _, length = project_rays(projection, np.broadcast_to(center, points.shape), directions)
    there = np.linalg.norm(project_points(projection, points) - start, axis=1)
    farther = np.linalg.norm(project_points(projection, points + sigma[:, None] * directions) - start, axis=1)
    there = np.where((depth > projection.near) & (there < length), there, np.nan)
    return there, np.abs(farther - there), stretch(space, points)


def marched_rays(
    space: Space, origins: Float[np.ndarray, "r 3"], directions: Float[np.ndarray, "r 3"]
) -> tuple[Float[np.ndarray, "r 3"], Float[np.ndarray, "r 3"], Float[np.ndarray, "r"]]:
    """Where normalised rays begin and point to as they are marched, and the t of infinity on each."""
    if space.is_projective:
        return project_rays(space.projection, origins, directions)
    return origins, directions, np.full(len(origins), np.inf)


def expected_distance(
    space: Space,
    origins: Float[np.ndarray, "r 3"],
    directions: Float[np.ndarray, "r 3"],
    length: Float[np.ndarray, "r"],
    depth: Float[np.ndarray, "r"],
    opacity: Float[np.ndarray, "r"],
    far: np.float32,
) -> Float[np.ndarray, "r"]:
    """Normalised distance at which rays end, from their expected t.

    In a projective space a ray ends at its own length; the expected place on it goes back to a distance.

    Args:
        origins, directions: Normalised.
        length: The t of infinity, see `marched_rays`.
        depth: Expected t, light that passes counted with `far`.
    """
    if not space.is_projective:
        return depth
    ended = (depth - (1 - opacity) * far) / np.maximum(length, 1e-9) + (1 - opacity)
    fraction = np.where(length > 0, ended, 1.0)
    return np.minimum(distance_along(space.projection, origins, directions, fraction), far)


def finite_box(
    space: Space, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The part of a box of the grid in which surfaces are looked for: no shell, no infinity."""
    if space.is_contracted:
        quarter = 0.25 * (upper - lower)
        return lower + quarter, upper - quarter
    if space.is_projective:
        return lower, np.append(upper[:2], MAX_DEPTH_RATIO * space.projection.depth)
    return lower, upper


def _reach(space: Space, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 1"]:
    """r: the largest coordinate of each point, in half sides of the inner cube."""
    return np.abs(points).max(axis=1, keepdims=True) / float(space.half_side)
