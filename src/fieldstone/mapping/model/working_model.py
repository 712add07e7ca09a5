"""The model in the making: poses that may be missing, points that may be nan, observations that may be dropped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.mapping_run import StageRecord
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations, compact_points
from fieldstone.solve.bundle.problem import BundleProblem


@dataclass(frozen=True, eq=False)
class WorkingModel:
    """xyz: nan for tracks that are not (or no longer) points. active: observations that have not been dropped."""

    cameras: tuple[Camera, ...]
    camera_of_view: Int[np.ndarray, "v"]
    cam_from_world: Rigid3
    """A batch with the pose of every view, C-contiguous; the identity where none is known."""
    registered: Bool[np.ndarray, "v"]
    """Which views have a pose."""
    tracks: Observations
    xyz: Float[np.ndarray, "t 3"]
    active: Bool[np.ndarray, "o"]
    pixel_scale: Float[np.ndarray, "v"]
    """See `MatchGraph`: thresholds are multiplied by it."""

    @staticmethod
    def start(
        cameras: tuple[Camera, ...],
        camera_of_view: Int[np.ndarray, "v"],
        tracks: Observations,
        pixel_scale: Float[np.ndarray, "v"] | None = None,
    ) -> WorkingModel:
        """No pose and no point yet.

        Args:
            pixel_scale: None: one everywhere.
        """
        v = len(camera_of_view)
        no_poses = Rigid3(np.tile(np.eye(3), (v, 1, 1)), np.zeros((v, 3)))
        num_tracks = int(tracks.point[-1]) + 1 if len(tracks) else 0
        xyz, active = np.full((num_tracks, 3), np.nan), np.ones(len(tracks), dtype=bool)
        scale = np.ones(v) if pixel_scale is None else pixel_scale
        return WorkingModel(cameras, camera_of_view, no_poses, np.zeros(v, dtype=bool), tracks, xyz, active, scale)

    @property
    def num_views(self) -> int:
        """Photos, registered or not."""
        return len(self.registered)

    @property
    def num_registered(self) -> int:
        """Photos with a pose."""
        return int(self.registered.sum())

    def camera_of(self, view: int) -> Camera:
        """The camera of a view."""
        return self.cameras[self.camera_of_view[view]]

    def scaled_focals(self) -> Float[np.ndarray, "v"]:
        """Mean focal length of every view over its pixel scale: an angle times it is an error for thresholds."""
        return np.array([self.camera_of(v).focal.mean() for v in range(self.num_views)]) / self.pixel_scale

    def typical_pixel_scale(self) -> float:
        """By what to multiply errors over pixel scales that are told of the whole model: the median of its photos."""
        return float(np.median(self.pixel_scale[self.registered])) if self.registered.any() else 1.0

    def pose_of(self, view: int) -> Rigid3:
        """`cam_from_world` of a registered view."""
        assert self.registered[view]
        return self.cam_from_world[view]

    def with_pose(self, view: int, cam_from_world: Rigid3) -> WorkingModel:
        """The model with one view registered."""
        return self.with_poses(np.array([view]), Rigid3.stack([cam_from_world]))

    def with_poses(self, views: Int[np.ndarray, "k"], cam_from_world: Rigid3) -> WorkingModel:
        """The model with these views registered, by a batch of poses."""
        R, t, registered = self.cam_from_world.R.copy(), self.cam_from_world.t.copy(), self.registered.copy()
        R[views], t[views], registered[views] = cam_from_world.R, cam_from_world.t, True
        return replace(self, cam_from_world=Rigid3(R, t), registered=registered)

    def only_registered(self, keep: Bool[np.ndarray, "v"]) -> WorkingModel:
        """The model in which views outside a mask have lost their pose."""
        registered = self.registered & keep
        R = np.where(registered[:, None, None], self.cam_from_world.R, np.eye(3))
        t = np.where(registered[:, None], self.cam_from_world.t, 0.0)
        return replace(self, cam_from_world=Rigid3(R, t), registered=registered)

    def on_tracks(self, tracks: Observations) -> WorkingModel:
        """The same cameras and poses, without a point yet, on other tracks."""
        start = WorkingModel.start(self.cameras, self.camera_of_view, tracks, self.pixel_scale)
        return replace(start, cam_from_world=self.cam_from_world, registered=self.registered)

    def all_tracks(self) -> Bool[np.ndarray, "t"]:
        """A mask of all tracks, whether they have a point or not."""
        return np.ones(len(self.xyz), dtype=bool)

    def is_point(self) -> Bool[np.ndarray, "t"]:
        """Which tracks have a position."""
        return np.isfinite(self.xyz[:, 0])

    def used_observations(self) -> Int[np.ndarray, "u"]:
        """Active observations of points by registered views."""
        return np.flatnonzero(self.active & self.registered[self.tracks.view] & self.is_point()[self.tracks.point])

    def observations_of(self, view: int) -> Int[np.ndarray, "u"]:
        """Active observations of points by one view, registered or not."""
        return np.flatnonzero(self.active & (self.tracks.view == view) & self.is_point()[self.tracks.point])

    def visible_points_per_view(self) -> Int[np.ndarray, "v"]:
        """How many points each view sees, registered or not."""
        rows = self.active & self.is_point()[self.tracks.point]
        return np.bincount(self.tracks.view[rows], minlength=self.num_views)

    def with_adjusted(self, problem: BundleProblem, views: Sequence[int], points: Int[np.ndarray, "p"]) -> WorkingModel:
        """The model with the cameras, poses and points of an adjusted problem."""
        xyz = self.xyz.copy()
        xyz[points] = problem.points
        return replace(self, cameras=problem.cameras, xyz=xyz).with_poses(np.asarray(views), problem.cam_from_world)


@dataclass(frozen=True, eq=False)
class Reprojections:
    """Reprojected pixels (nan behind the camera) and errors (inf there) of the observations `rows`."""

    rows: Int[np.ndarray, "u"]
    pixels: Float[np.ndarray, "u 2"]
    errors: Float[np.ndarray, "u"]
    """In pixels of the photos."""
    scaled_errors: Float[np.ndarray, "u"]
    """Over the pixel scale of the photo: what thresholds are compared with."""


def reprojections(model: WorkingModel, rows: Int[np.ndarray, "u"] | None = None) -> Reprojections:
    """Where the model's points appear in its registered views; by default for all used observations."""
    if rows is None:
        rows = model.used_observations()
    view, point = model.tracks.view[rows], model.tracks.point[rows]
    in_cam = model.cam_from_world[view].apply(model.xyz[point])
    pixels = np.empty((len(rows), 2))
    for c, camera in enumerate(model.cameras):
        mine = model.camera_of_view[view] == c
        pixels[mine] = image_from_cam(camera, in_cam[mine])
    errors = np.linalg.norm(pixels - model.tracks.pixels[rows], axis=1)
    errors = np.nan_to_num(errors, nan=np.inf)
    return Reprojections(rows, pixels, errors, errors / model.pixel_scale[view])


def record_views(
    model: WorkingModel,
    names: Sequence[str],
    stage: str,
    views: Sequence[int] | None = None,
    points: Bool[np.ndarray, "t"] | None = None,
) -> list[StageRecord]:
    """A record of every registered view, or of those named, for all points or those of a mask."""
    result = reprojections(model)
    view, point = model.tracks.view[result.rows], model.tracks.point[result.rows]
    chosen = np.ones(len(view), dtype=bool) if points is None else points[point]
    records = []
    for v in np.flatnonzero(model.registered).tolist() if views is None else views:
        mine = (view == v) & chosen
        pixels = model.tracks.pixels[result.rows[mine]]
        records.append(StageRecord(stage, v, names[v], pixels, result.pixels[mine]))
    return records


def to_reconstruction(model: WorkingModel, graph: MatchGraph) -> Reconstruction:
    """The frozen result: points that are left, coloured by the mean of their keypoints."""
    rows = model.used_observations()
    kept = Observations(
        model.tracks.view[rows], model.tracks.keypoint[rows], model.tracks.point[rows], model.tracks.pixels[rows]
    )
    is_seen = np.zeros(len(model.xyz), dtype=bool)
    is_seen[kept.point] = True
    observations = compact_points(kept, is_seen)
    sums = np.zeros((int(is_seen.sum()), 3))
    for v in np.unique(observations.view):
        mine = observations.view == v
        np.add.at(sums, observations.point[mine], graph.colors[v][observations.keypoint[mine]])
    lengths = np.bincount(observations.point, minlength=len(sums))
    rgb = np.round(sums / np.maximum(lengths, 1)[:, None]).astype(np.uint8)
    views = tuple(
        View(name, int(model.camera_of_view[v]), model.pose_of(v) if model.registered[v] else None)
        for v, name in enumerate(graph.names)
    )
    return Reconstruction(model.cameras, views, Points(model.xyz[is_seen], rgb), observations)
