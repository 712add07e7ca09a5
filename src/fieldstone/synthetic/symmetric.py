"""A building whose four sides are the same: photos all around it match falsely as well as truly.

A feature of a facade looks like the same feature of the other three, as long as both are seen from about the same
side. So two photos that are 90 degrees (and a little) apart match as if only that little lay between them, with a
perfect two-view geometry, and false pairs are three times as many as true ones. Features of the ground and of the
surroundings are of one place only: they alone tell the sides apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.synthetic.repeated_structure import (
    PhotographOptions,
    RepeatedPlace,
    RepeatedScene,
    in_view,
    photograph_repeated,
)
from fieldstone.synthetic.scenes import default_camera

SIDES = 4
HALF_WIDTH, HEIGHT, RELIEF = 1.0, 1.6, 0.12
"""Of the building, and how far its facades reach out; scene units."""
GROUND_RADIUS, FAR_RADII = 3.0, (5.0, 12.0)


@dataclass(frozen=True)
class SymmetricOptions:
    """A ring of photos around the building."""

    num_photos: int = 28
    points_per_side: int = 400
    unique_share: float = 0.1
    """Share of a photo's keypoints that show the ground or the surroundings, which are not symmetric; on average."""
    looks: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Facades with equal numbers are the same: (0, 1, 2, 3) is an ordinary building, (0, 1, 0, 2) an object with front
    and back alike."""
    sweep_deg: float = 360.0
    """The photos stand on an arc of this angle; 360 closes the ring."""
    jitter_deg: float = 2.0
    """How unevenly the photos are spaced, and how far they look past the middle; half range."""
    shuffled: bool = False
    """The order of the photos tells nothing of where they stand."""
    unevenness: float = 1.0
    """How much heights and distances of the cameras differ: 0 makes photos of different sides exactly alike."""
    distance: float = 3.6
    """From the middle of the building to the cameras."""
    visibility: float = 0.75
    """Probability that a photo has a keypoint where it sees a point."""
    max_view_change_deg: float = 40.0
    """Descriptors of one feature are alike while its azimuths of view differ by less."""
    noise_px: float = 0.5
    camera: Camera = field(default_factory=default_camera)

    def __post_init__(self) -> None:
        if self.num_photos < 2 or self.points_per_side < 1:
            raise ValueError(f"need 2 photos and 1 point a side, got {self.num_photos} and {self.points_per_side}")
        if not 0 <= self.unique_share < 1:
            raise ValueError(f"unique_share must lie in [0, 1), got {self.unique_share}")


def synthesize_symmetric(options: SymmetricOptions, rng: np.random.Generator) -> RepeatedScene:
    """Photograph the building: exact poses, noisy keypoints, and the matches that the ratio test leaves."""
    poses = _ring(options, rng)
    place = _place(options, poses, rng)

    def sees(cam_from_world: Rigid3) -> Bool[np.ndarray, "p"]:
        return _sees(options, cam_from_world, place)

    photographs = PhotographOptions(options.camera, options.visibility, options.max_view_change_deg, options.noise_px)
    return photograph_repeated(place, poses, sees, photographs, rng)


def _ring(options: SymmetricOptions, rng: np.random.Generator) -> Rigid3:
    """`cam_from_world` of the photos; z is up."""
    n, jitter = options.num_photos, np.deg2rad(options.jitter_deg)
    sweep = np.deg2rad(options.sweep_deg)
    step = sweep / n if options.sweep_deg >= 360 else sweep / (n - 1)
    azimuth = step * np.arange(n) + rng.uniform(-jitter, jitter, size=n)
    if options.shuffled:
        azimuth = rng.permutation(azimuth)
    distance = options.distance * (1.0 + 0.05 * options.unevenness * rng.uniform(-1, 1, size=n))
    height = 1.0 + 0.3 * options.unevenness * rng.uniform(-1, 1, size=n)
    centers = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    sway = options.unevenness * rng.uniform(-0.1, 0.1, size=(3, n))
    targets = np.stack([sway[0], sway[1], 0.6 + sway[2]], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    return Rigid3.stack([look_at(c, t, up) for c, t in zip(centers, targets, strict=True)])


def _place(options: SymmetricOptions, poses: Rigid3, rng: np.random.Generator) -> RepeatedPlace:
    """Four facades, and as much ground and surroundings as give the wanted share of keypoints."""
    n = options.points_per_side
    facade = rng.uniform([HALF_WIDTH, -HALF_WIDTH, 0.0], [HALF_WIDTH + RELIEF, HALF_WIDTH, HEIGHT], size=(n, 3))
    angles = np.arange(SIDES) * (2 * np.pi / SIDES)
    turns = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles])
    sides = np.einsum("sij,nj->sni", turns, facade).reshape(-1, 3)
    look = (np.array(options.looks)[:, None] * n + np.arange(n)).ravel()
    building = RepeatedPlace(sides, np.repeat(angles, n), look)
    if options.unique_share == 0:
        return building
    candidates = _surroundings(20 * n, rng)
    around = RepeatedPlace(candidates, np.full(len(candidates), np.nan), SIDES * n + np.arange(len(candidates)))
    counts = [
        np.mean([_sees(options, poses[k], part).sum() for k in range(options.num_photos)])
        for part in (building, around)
    ]
    wanted = options.unique_share / (1 - options.unique_share) * counts[0] / counts[1]
    kept = slice(0, round(min(wanted, 1.0) * len(candidates)))
    return RepeatedPlace(
        np.concatenate([building.xyz, around.xyz[kept]]),
        np.concatenate([building.facing, around.facing[kept]]),
        np.concatenate([building.look, around.look[kept]]),
    )


def _surroundings(count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Points of the ground next to the building and of a belt far behind it, in random order."""
    angle = rng.uniform(0, 2 * np.pi, size=count)
    far = rng.uniform(size=count) < 0.5
    radius = np.where(far, rng.uniform(*FAR_RADII, size=count), GROUND_RADIUS * np.sqrt(rng.uniform(size=count)))
    height = np.where(far, rng.uniform(0.0, 4.0, size=count), 0.0)
    xyz = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return xyz[far | (np.abs(xyz[:, :2]).max(axis=1) > HALF_WIDTH + RELIEF)]


def _sees(options: SymmetricOptions, cam_from_world: Rigid3, place: RepeatedPlace) -> Bool[np.ndarray, "p"]:
    """In the image, on the near side of the building, and not behind it."""
    behind = _behind_building(cam_from_world.target_origin_in_source(), place.xyz)
    return in_view(options.camera, cam_from_world, place) & (np.isfinite(place.facing) | ~behind)


def _behind_building(center: Float[np.ndarray, "3"], xyz: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, "p"]:
    """Whether the segment from the camera to each point meets the box of the building (slab test)."""
    low, high = np.array([-HALF_WIDTH, -HALF_WIDTH, -1.0]), np.array([HALF_WIDTH, HALF_WIDTH, HEIGHT])
    with np.errstate(divide="ignore"):
        first, second = ((bound - center) / (xyz - center) for bound in (low, high))
    enters = np.minimum(first, second).max(axis=1)
    leaves = np.maximum(first, second).min(axis=1)
    return (enters < leaves) & (leaves > 0) & (enters < 1)
