"""A street of equal houses: photos taken while walking past it match falsely with those of every other house.

All houses look in one direction, so false pairs ask for no other rotation: only their place along the street is wrong.
Features of the pavement are of one place only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

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

HOUSE_WIDTH, HOUSE_HEIGHT, RELIEF = 2.0, 1.6, 0.25
"""Scene units; the street runs along x, and the houses face -y."""
PAVEMENT = (0.1, 0.9)
"""Distances from the houses between which the pavement lies."""


@dataclass(frozen=True)
class StreetOptions:
    """A row of houses, and photos taken from the other side of the street."""

    num_houses: int = 5
    photos_per_house: int = 5
    points_per_house: int = 300
    unique_share: float = 0.15
    """Share of the points that are of one place only."""
    houses_differ: bool = False
    """Every house has features of its own: an ordinary street."""
    distance: float = 2.2
    """From the houses to the cameras."""
    unevenness: float = 1.0
    """How much cameras sway and turn; 0 makes photos of different houses exactly alike."""
    visibility: float = 0.75
    max_view_change_deg: float = 40.0
    noise_px: float = 0.5
    camera: Camera = field(default_factory=default_camera)


def synthesize_street(options: StreetOptions, rng: np.random.Generator) -> RepeatedScene:
    """Photograph the street: exact poses, noisy keypoints, and the matches that the ratio test leaves."""
    place, poses = _place(options, rng), _walk(options, rng)

    def sees(cam_from_world: Rigid3) -> Bool[np.ndarray, "p"]:
        return in_view(options.camera, cam_from_world, place)

    photographs = PhotographOptions(options.camera, options.visibility, options.max_view_change_deg, options.noise_px)
    return photograph_repeated(place, poses, sees, photographs, rng)


def _place(options: StreetOptions, rng: np.random.Generator) -> RepeatedPlace:
    """The houses side by side, and the pavement in front of them, whose share of the points is unique."""
    n, houses = options.points_per_house, options.num_houses
    house = rng.uniform([0.0, 0.0, 0.0], [HOUSE_WIDTH, RELIEF, HOUSE_HEIGHT], size=(n, 3))
    steps = np.zeros((houses, 1, 3))
    steps[:, 0, 0] = HOUSE_WIDTH * np.arange(houses)
    xyz = (house + steps).reshape(-1, 3)
    look = np.arange(houses * n) if options.houses_differ else np.tile(np.arange(n), houses)
    count = round(options.unique_share / (1.0 - options.unique_share) * len(xyz))
    pavement = rng.uniform([0.0, -PAVEMENT[1], 0.0], [houses * HOUSE_WIDTH, -PAVEMENT[0], 0.02], size=(count, 3))
    return RepeatedPlace(
        np.concatenate([xyz, pavement]),
        np.concatenate([np.full(len(xyz), -np.pi / 2), np.full(count, np.nan)]),
        np.concatenate([look, houses * n + np.arange(count)]),
    )


def _walk(options: StreetOptions, rng: np.random.Generator) -> Rigid3:
    """`cam_from_world` of photos in the order of the walk; z is up."""
    count = options.num_houses * options.photos_per_house
    x = HOUSE_WIDTH * (np.arange(count) + 0.5) / options.photos_per_house
    sway = options.unevenness * rng.uniform(-1.0, 1.0, size=(4, count))
    centers = np.stack([x + 0.05 * sway[0], -options.distance * (1.0 + 0.05 * sway[1]), 0.7 + 0.1 * sway[2]], axis=1)
    targets = np.stack([x + 0.3 * sway[3], np.zeros(count), np.full(count, 0.6)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    return Rigid3.stack([look_at(c, t, up) for c, t in zip(centers, targets, strict=True)])
