"""A building whose four sides are the same: photos all around it match falsely as well as truly.

A feature of a facade looks like the same feature of the other three, as long as both are seen from about the same
side. So two photos that are 90 degrees (and a little) apart match as if only that little lay between them, with a
perfect two-view geometry, and false pairs are three times as many as true ones. Features of the ground and of the
surroundings are of one place only: they alone tell the sides apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic.scenes import default_camera

SIDES = 4
HALF_WIDTH, HEIGHT, RELIEF = 1.0, 1.6, 0.12
"""Of the building, and how far its facades reach out; scene units."""
GROUND_RADIUS, FAR_RADII = 3.0, (5.0, 12.0)
MAX_OBLIQUENESS_DEG = 70.0
"""A facade that is seen more obliquely has no features."""


@dataclass(frozen=True)
class SymmetricOptions:
    """A ring of photos around the building."""

    num_photos: int = 28
    points_per_side: int = 400
    unique_share: float = 0.1
    """Share of a photo's keypoints that show the ground or the surroundings, which are not symmetric; on average."""
    sides_differ: bool = False
    """The four facades have features of their own: an ordinary building."""
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


@dataclass(frozen=True, eq=False)
class SymmetricScene:
    """The truth, what a matcher finds, and which of the matches join keypoints of one point."""

    truth: Reconstruction
    graph: MatchGraph
    azimuth: Float[np.ndarray, "n"]
    """Of the cameras around the building, in radians."""
    true_matches: dict[ImagePair, Bool[np.ndarray, "_"]]

    def is_true(self, pair: ImagePair) -> bool:
        """Whether most of a pair's matches are true."""
        return bool(np.mean(self.true_matches[pair]) > 0.5)


@dataclass(frozen=True, eq=False)
class _World:
    """Points, the direction in plan that each faces (nan: any), and the look of each: equal numbers look alike."""

    xyz: Float[np.ndarray, "p 3"]
    facing: Float[np.ndarray, "p"]
    look: Int[np.ndarray, "p"]


def synthesize_symmetric(options: SymmetricOptions, rng: np.random.Generator) -> SymmetricScene:
    """Photograph the building: exact poses, noisy keypoints, and the matches that the ratio test leaves.

    A feature that has two equal candidates in the other photo matches neither.
    """
    azimuth, poses = _ring(options, rng)
    world = _world(options, poses, rng)
    n = options.num_photos
    keypoints, owners, views = [], [], []
    for k in range(n):
        mine = rng.permutation(np.flatnonzero(_sees(options, poses[k], world)))
        mine = mine[rng.uniform(size=len(mine)) < options.visibility]
        exact = image_from_cam(options.camera, poses[k].apply(world.xyz[mine]))
        keypoints.append(exact + options.noise_px * rng.normal(size=exact.shape))
        owners.append(mine)
        views.append(_azimuth_of_view(poses[k], world, mine))
    matches, true_matches = {}, {}
    for i in range(n):
        for j in range(i + 1, n):
            first, second = (world.look[owners[k]] for k in (i, j))
            rows = _ratio_test(first, second, views[i], views[j], np.deg2rad(options.max_view_change_deg))
            if len(rows):
                matches[i, j] = rows
                true_matches[i, j] = owners[i][rows[:, 0]] == owners[j][rows[:, 1]]
    names = tuple(f"photo_{k:04d}.png" for k in range(n))
    grey = tuple(np.full((len(k), 3), 128, dtype=np.uint8) for k in keypoints)
    points = Points(world.xyz, np.full((len(world.xyz), 3), 128, dtype=np.uint8))
    posed = tuple(View(name, 0, poses[k]) for k, name in enumerate(names))
    truth = Reconstruction((options.camera,), posed, points, Observations.empty())
    return SymmetricScene(truth, MatchGraph(names, tuple(keypoints), grey, matches), azimuth, true_matches)


def _ring(options: SymmetricOptions, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n"], Rigid3]:
    """Azimuths and `cam_from_world` of the photos; z is up."""
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
    return azimuth, Rigid3.stack([look_at(c, t, up) for c, t in zip(centers, targets, strict=True)])


def _world(options: SymmetricOptions, poses: Rigid3, rng: np.random.Generator) -> _World:
    """Four facades, and as much ground and surroundings as give the wanted share of keypoints."""
    n = options.points_per_side
    facade = rng.uniform([HALF_WIDTH, -HALF_WIDTH, 0.0], [HALF_WIDTH + RELIEF, HALF_WIDTH, HEIGHT], size=(n, 3))
    angles = np.arange(SIDES) * (2 * np.pi / SIDES)
    turns = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles])
    sides = np.einsum("sij,nj->sni", turns, facade).reshape(-1, 3)
    look = np.arange(SIDES * n) if options.sides_differ else np.tile(np.arange(n), SIDES)
    building = _World(sides, np.repeat(angles, n), look)
    if options.unique_share == 0:
        return building
    candidates = _surroundings(20 * n, rng)
    around = _World(candidates, np.full(len(candidates), np.nan), SIDES * n + np.arange(len(candidates)))
    counts = [
        np.mean([_sees(options, poses[k], part).sum() for k in range(options.num_photos)])
        for part in (building, around)
    ]
    wanted = options.unique_share / (1 - options.unique_share) * counts[0] / counts[1]
    kept = slice(0, round(min(wanted, 1.0) * len(candidates)))
    return _World(
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


def _sees(options: SymmetricOptions, cam_from_world: Rigid3, world: _World) -> Bool[np.ndarray, "p"]:
    """In the image, on the near side of the building, and not behind it."""
    camera, center = options.camera, cam_from_world.target_origin_in_source()
    in_cam = cam_from_world.apply(world.xyz)
    pixels = image_from_cam(camera, in_cam)
    inside = (in_cam[:, 2] > 0.1) & np.all((pixels > 1) & (pixels < [camera.width - 1, camera.height - 1]), axis=1)
    towards = center - world.xyz
    normal = np.stack([np.cos(world.facing), np.sin(world.facing), np.zeros(len(world.xyz))], axis=1)
    cosine = np.sum(normal * towards, axis=1) / np.linalg.norm(towards, axis=1)
    on_building = np.isfinite(world.facing)
    faces = cosine > np.cos(np.deg2rad(MAX_OBLIQUENESS_DEG))
    return inside & np.where(on_building, faces, ~_behind_building(center, world.xyz))


def _behind_building(center: Float[np.ndarray, "3"], xyz: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, "p"]:
    """Whether the segment from the camera to each point meets the box of the building (slab test)."""
    low, high = np.array([-HALF_WIDTH, -HALF_WIDTH, -1.0]), np.array([HALF_WIDTH, HALF_WIDTH, HEIGHT])
    with np.errstate(divide="ignore"):
        first, second = ((bound - center) / (xyz - center) for bound in (low, high))
    enters = np.minimum(first, second).max(axis=1)
    leaves = np.maximum(first, second).min(axis=1)
    return (enters < leaves) & (leaves > 0) & (enters < 1)


def _azimuth_of_view(cam_from_world: Rigid3, world: _World, points: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """From which side each point is seen, relative to the facade that it lies on."""
    towards = cam_from_world.target_origin_in_source() - world.xyz[points]
    return np.arctan2(towards[:, 1], towards[:, 0]) - np.nan_to_num(world.facing[points])


def _ratio_test(
    look1: Int[np.ndarray, "a"],
    look2: Int[np.ndarray, "b"],
    azimuth1: Float[np.ndarray, "a"],
    azimuth2: Float[np.ndarray, "b"],
    max_change: float,
) -> Int[np.ndarray, "m 2"]:
    """Pairs that look alike, each of which has no other candidate in the other photo."""
    order = np.argsort(look2, kind="stable")
    low = np.searchsorted(look2[order], look1, side="left")
    high = np.searchsorted(look2[order], look1, side="right")
    a = np.repeat(np.arange(len(look1)), high - low)
    b = order[np.concatenate([np.arange(x, y) for x, y in zip(low, high, strict=True)] or [np.empty(0, dtype=int)])]
    change = np.abs(np.angle(np.exp(1j * (azimuth1[a] - azimuth2[b]))))
    a, b = a[change < max_change], b[change < max_change]
    alone = (np.bincount(a, minlength=len(look1))[a] == 1) & (np.bincount(b, minlength=len(look2))[b] == 1)
    return np.stack([a[alone], b[alone]], axis=1).astype(np.int64)
