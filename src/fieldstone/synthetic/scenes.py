"""Scenes of points and cameras with exact truth, and the matches that a matcher would have found in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.geometry.camera import Camera, bearings_from_image, image_from_cam
from fieldstone.geometry.epipolar import essential_from_pose
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations

Layout = Literal["ring", "arc", "street", "random"]
PointShape = Literal["volume", "plane"]
Topology = Literal["all_pairs", "sequential", "ring"]

MAX_DRAWS = 200
STREET_STEP = 0.5


def default_camera() -> Camera:
    """A camera of 1000 x 750 pixels with a field of view of 64 x 50 degrees, principal point off the centre."""
    return Camera("PINHOLE", 1000, 750, np.array([800.0, 810.0, 505.0, 370.0]))


@dataclass(frozen=True)
class SceneOptions:
    """What to build; distances are in scene units, the points fill about the unit ball (for a street: its length)."""

    num_cameras: int = 8
    """Number of photos, all of one camera."""
    num_points: int = 300
    """Number of points, each seen by at least two cameras."""
    layout: Layout = "ring"
    """ring: all around, looking in; arc: a quarter of it; street: along a facade, looking sideways; random: anywhere
    on a sphere, with any roll."""
    point_shape: PointShape = "volume"
    """volume: a ball (street: a slab); plane: the ground (street: the facade)."""
    camera: Camera = field(default_factory=default_camera)
    """Intrinsics, distortion included, shared by all photos."""
    visibility: float = 1.0
    """Probability that a camera which could see a point does so."""
    max_track_length: int | None = None
    """Longest track: a run of consecutive cameras; None for no limit."""
    noise_px: float = 0.0
    """Standard deviation of the keypoints per axis, in pixels."""
    outlier_share: float = 0.0
    """Share of each pair's matches that join keypoints of different points."""
    num_clutter: int = 0
    """Keypoints per photo that show no point; false matches may take them."""
    topology: Topology = "all_pairs"
    """Which pairs are matched: all, or each photo with the `num_neighbors` next ones (ring: also across the end)."""
    num_neighbors: int = 3
    """For `sequential` and `ring`."""

    def __post_init__(self) -> None:
        if self.num_cameras < 2 or self.num_points < 1:
            raise ValueError(f"a scene needs 2 cameras and 1 point, got {self.num_cameras} and {self.num_points}")
        if self.layout not in ("ring", "arc", "street", "random"):
            raise ValueError(f"layout must be ring, arc, street or random, got {self.layout!r}")
        if self.point_shape not in ("volume", "plane"):
            raise ValueError(f"point_shape must be volume or plane, got {self.point_shape!r}")
        if self.topology not in ("all_pairs", "sequential", "ring"):
            raise ValueError(f"topology must be all_pairs, sequential or ring, got {self.topology!r}")
        if not 0 < self.visibility <= 1:
            raise ValueError(f"visibility must lie in (0, 1], got {self.visibility}")
        if self.max_track_length is not None and self.max_track_length < 2:
            raise ValueError(f"max_track_length must be at least 2, got {self.max_track_length}")
        if not (np.isfinite(self.noise_px) and self.noise_px >= 0):
            raise ValueError(f"noise_px must be finite and not negative, got {self.noise_px}")
        if not 0 <= self.outlier_share < 1:
            raise ValueError(f"outlier_share must lie in [0, 1), got {self.outlier_share}")
        if self.num_clutter < 0 or self.num_neighbors < 1:
            raise ValueError(f"need num_clutter >= 0, num_neighbors >= 1: {self.num_clutter}, {self.num_neighbors}")


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A world and what was measured of it.

    truth: exact poses, points and colours; its observations hold the measured (noisy) keypoints of `graph`, so
    `truth.reprojection_errors()` is the noise that was put in. inliers: per pair, which rows of `graph.matches` join
    keypoints of one point. The graph itself has no two-view geometry; see `verified_graph`.
    """

    truth: Reconstruction
    graph: MatchGraph
    inliers: Mapping[ImagePair, Bool[np.ndarray, "_"]]

    def cam2_from_cam1(self, pair: ImagePair) -> Rigid3:
        """The true relative pose of a pair, in scene units."""
        return self.truth.pose_of(pair[1]) @ self.truth.pose_of(pair[0]).inverse()

    def verified_graph(self) -> MatchGraph:
        """The graph with every pair's true calibrated geometry and true inliers."""
        two_views = {}
        for pair, inliers in self.inliers.items():
            relative = self.cam2_from_cam1(pair)
            unit = Rigid3(relative.R, relative.t / np.linalg.norm(relative.t))
            two_views[pair] = TwoView("calibrated", essential_from_pose(unit), unit, inliers)
        return self.graph.with_two_views(two_views)


def synthesize(options: SceneOptions, rng: np.random.Generator) -> SyntheticScene:
    """Draw a scene: cameras, points that at least two of them see, noisy keypoints, true and false matches.

    Every observed point lies in front of its camera and inside its image, before and after noise. Keypoints are in
    random order, so that an index of one table used in another shows.

    Raises:
        ValueError: The cameras cannot see enough points (a camera with a tiny field of view, or a street with steps
            longer than what two neighbours share).
    """
    poses = _camera_poses(options, rng)
    xyz, seen = _visible_points(options, poses, rng)
    points = Points(xyz, rng.integers(0, 256, size=(len(xyz), 3), dtype=np.uint8))
    keypoints, colors, point_of_keypoint = [], [], []
    for i in range(options.num_cameras):
        pixels, rgb, owner = _photo_keypoints(options, poses[i], points, np.flatnonzero(seen[i]), rng)
        keypoints.append(pixels)
        colors.append(rgb)
        point_of_keypoint.append(owner)
    matches, inliers = {}, {}
    for pair in _pairs(options):
        rows = _match_pair(options, point_of_keypoint[pair[0]], point_of_keypoint[pair[1]], rng)
        if len(rows):
            matches[pair] = rows
            inliers[pair] = point_of_keypoint[pair[0]][rows[:, 0]] == point_of_keypoint[pair[1]][rows[:, 1]]
    names = tuple(f"photo_{i:04d}.png" for i in range(options.num_cameras))
    views = tuple(View(name, 0, poses[i]) for i, name in enumerate(names))
    truth = Reconstruction((options.camera,), views, points, _observations(keypoints, point_of_keypoint))
    return SyntheticScene(truth, MatchGraph(names, tuple(keypoints), tuple(colors), matches), inliers)


def _camera_poses(options: SceneOptions, rng: np.random.Generator) -> Rigid3:
    """`cam_from_world` of all cameras; z is up in the world."""
    n = options.num_cameras
    distance = _viewing_distance(options.camera)
    up = np.array([0.0, 0.0, 1.0])
    if options.layout == "street":
        along = STREET_STEP * (np.arange(n) - (n - 1) / 2)
        centers = np.stack([along, np.full(n, -distance), np.zeros(n)], axis=1)
        centers += rng.uniform(-0.05, 0.05, size=(n, 3))
        targets = centers + np.array([0.0, distance, 0.0]) + rng.uniform(-0.1, 0.1, size=(n, 3))
        return Rigid3.stack([look_at(c, t, up) for c, t in zip(centers, targets, strict=True)])
    if options.layout == "random":
        directions = rng.normal(size=(n, 3))
        centers = distance * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        ups = rng.normal(size=(n, 3))
    else:
        sweep = 2 * np.pi * (n - 1) / n if options.layout == "ring" else np.pi / 2
        azimuth = np.linspace(0.0, sweep, n) + rng.uniform(-0.02, 0.02, size=n)
        elevation = rng.uniform(0.35, 0.6, size=n)
        centers = distance * np.stack(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
        )
        ups = np.broadcast_to(up, (n, 3))
    targets = rng.uniform(-0.1, 0.1, size=(n, 3))
    return Rigid3.stack([look_at(c, t, u) for c, t, u in zip(centers, targets, ups, strict=True)])


def _viewing_distance(camera: Camera) -> float:
    """From where the unit ball fills most of the smaller side of the image."""
    half_angle = float(np.arctan(0.5 * min(camera.width, camera.height) / camera.focal.max()))
    return 1.2 / np.sin(half_angle)


def _visible_points(
    options: SceneOptions, poses: Rigid3, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "p 3"], Bool[np.ndarray, "v p"]]:
    """Points that at least two cameras observe, and which ones do."""
    xyz = np.empty((0, 3))
    seen = np.empty((options.num_cameras, 0), dtype=bool)
    for _ in range(MAX_DRAWS):
        candidates = _draw_points(options, rng)
        visible = np.stack([_inside(options.camera, poses[i], candidates) for i in range(options.num_cameras)])
        visible = _thin(options, visible, rng)
        kept = visible.sum(axis=0) >= 2
        xyz = np.concatenate([xyz, candidates[kept]])
        seen = np.concatenate([seen, visible[:, kept]], axis=1)
        if len(xyz) >= options.num_points:
            return xyz[: options.num_points], seen[:, : options.num_points]
    raise ValueError(f"found {len(xyz)} of {options.num_points} points that two cameras see: change camera or layout")


def _draw_points(options: SceneOptions, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Candidates: uniform in the unit ball or on the unit disc, or in the slab behind a street's facade."""
    n = options.num_points
    if options.layout == "street":
        half_length = 1.0 + 0.5 * STREET_STEP * (options.num_cameras - 1)
        depth = 0.0 if options.point_shape == "plane" else 1.0
        return rng.uniform([-half_length, 0.0, -1.0], [half_length, depth, 1.0], size=(n, 3))
    size = 2 if options.point_shape == "plane" else 3
    direction = rng.normal(size=(n, size))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = np.zeros((n, 3))
    points[:, :size] = direction * rng.uniform(size=(n, 1)) ** (1 / size)
    return points


def _inside(camera: Camera, cam_from_world: Rigid3, xyz: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """In front of the camera, inside its image, and where its distortion is one to one."""
    in_cam = cam_from_world.apply(xyz)
    pixels = image_from_cam(camera, in_cam)
    inside = _in_image(camera, pixels)
    direction = in_cam[inside] / np.linalg.norm(in_cam[inside], axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        inside[inside] = np.linalg.norm(bearings_from_image(camera, pixels[inside]) - direction, axis=1) < 1e-6
    return inside


def _in_image(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    return np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)


def _thin(options: SceneOptions, visible: Bool[np.ndarray, "v n"], rng: np.random.Generator) -> Bool[np.ndarray, "v n"]:
    """Shorten tracks to a run of `max_track_length` cameras, then drop observations at random."""
    if options.max_track_length is not None:
        v, n = visible.shape
        # A random seeing camera starts the run; a ring closes on itself.
        start = np.argmax(np.where(visible, rng.uniform(size=(v, n)), -1.0), axis=0)
        steps = np.arange(v)[:, None] - start
        if options.layout == "ring":
            steps %= v
        visible = visible & (steps >= 0) & (steps < options.max_track_length)
    return visible & (rng.uniform(size=visible.shape) < options.visibility)


def _photo_keypoints(
    options: SceneOptions,
    cam_from_world: Rigid3,
    points: Points,
    observed: Int[np.ndarray, "s"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "n 2"], UInt8[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Keypoints of one photo in random order, their colours, and the point that each shows (clutter: -1)."""
    camera, n = options.camera, options.num_clutter
    exact = image_from_cam(camera, cam_from_world.apply(points.xyz[observed]))
    noisy = exact + options.noise_px * rng.normal(size=exact.shape)
    for _ in range(MAX_DRAWS):
        outside = ~_in_image(camera, noisy)
        if not outside.any():
            break
        noisy[outside] = exact[outside] + options.noise_px * rng.normal(size=(int(outside.sum()), 2))
    noisy = np.where(_in_image(camera, noisy)[:, None], noisy, exact)
    clutter = rng.uniform(0.0, [camera.width, camera.height], size=(n, 2))
    pixels = np.concatenate([noisy, clutter])
    rgb = np.concatenate([points.rgb[observed], rng.integers(0, 256, size=(n, 3), dtype=np.uint8)])
    owner = np.concatenate([observed, np.full(n, -1)])
    order = rng.permutation(len(pixels))
    return pixels[order], rgb[order], owner[order]


def _pairs(options: SceneOptions) -> list[ImagePair]:
    """The pairs of the topology, in order."""
    n = options.num_cameras
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    if options.topology == "all_pairs":
        return pairs
    wraps = options.topology == "ring"
    return [(i, j) for i, j in pairs if (min(j - i, n - j + i) if wraps else j - i) <= options.num_neighbors]


def _match_pair(
    options: SceneOptions,
    owner1: Int[np.ndarray, "n"],
    owner2: Int[np.ndarray, "m"],
    rng: np.random.Generator,
) -> Int[np.ndarray, "k 2"]:
    """One-to-one matches of one pair, `outlier_share` of them false, in random order.

    A false match is a true one whose second keypoint was swapped for that of another false match or for clutter.
    """
    _, first, second = np.intersect1d(
        np.where(owner1 >= 0, owner1, -1 - np.arange(len(owner1))),
        np.where(owner2 >= 0, owner2, -1 - len(owner1) - np.arange(len(owner2))),
        return_indices=True,
    )
    rows = rng.permutation(np.stack([first, second], axis=1))
    num_false = round(options.outlier_share * len(rows))
    false, true = rows[:num_false], rows[num_false:]
    if num_false:
        # One step around the circle of candidates: no match keeps its own keypoint, none is used twice.
        candidates = np.concatenate([false[:, 1], rng.permutation(np.flatnonzero(owner2 < 0))])
        order = rng.permutation(len(candidates))
        swapped = np.empty(len(candidates), dtype=np.int64)
        swapped[order] = candidates[np.roll(order, 1)]
        false = np.stack([false[:, 0], swapped[:num_false]], axis=1)
        if len(candidates) == 1:
            false = false[:0]
    return rng.permutation(np.concatenate([false, true]))


def _observations(
    keypoints: list[Float[np.ndarray, "_ 2"]], point_of_keypoint: list[Int[np.ndarray, "_"]]
) -> Observations:
    """All keypoints that show a point, sorted by point, then view."""
    counts = [len(k) for k in keypoints]
    view = np.repeat(np.arange(len(counts)), counts)
    keypoint = np.concatenate([np.arange(c) for c in counts])
    point = np.concatenate(point_of_keypoint)
    pixels = np.concatenate(keypoints)
    order = np.lexsort((view, point))
    order = order[point[order] >= 0]
    return Observations(view[order], keypoint[order], point[order], pixels[order])
