"""The model while it grows: poses that may be missing, points that may be nan, observations that may be dropped."""

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
    poses: tuple[Rigid3 | None, ...]
    tracks: Observations
    xyz: Float[np.ndarray, "t 3"]
    active: Bool[np.ndarray, "o"]

    @staticmethod
    def start(cameras: tuple[Camera, ...], camera_of_view: Int[np.ndarray, "v"], tracks: Observations) -> WorkingModel:
        """No pose and no point yet."""
        num_tracks = int(tracks.point[-1]) + 1 if len(tracks) else 0
        poses: tuple[Rigid3 | None, ...] = (None,) * len(camera_of_view)
        return WorkingModel(
            cameras, camera_of_view, poses, tracks, np.full((num_tracks, 3), np.nan), np.ones(len(tracks), dtype=bool)
        )

    @property
    def num_views(self) -> int:
        """Photos, registered or not."""
        return len(self.poses)

    def camera_of(self, view: int) -> Camera:
        """The camera of a view."""
        return self.cameras[self.camera_of_view[view]]

    def pose_of(self, view: int) -> Rigid3:
        """`cam_from_world` of a registered view."""
        pose = self.poses[view]
        assert pose is not None
        return pose

    def with_pose(self, view: int, cam_from_world: Rigid3) -> WorkingModel:
        """The model with one more registered view."""
        poses = list(self.poses)
        poses[view] = cam_from_world
        return replace(self, poses=tuple(poses))

    def registered_mask(self) -> Bool[np.ndarray, "v"]:
        """Which views have a pose."""
        return np.array([pose is not None for pose in self.poses], dtype=bool)

    def stacked_poses(self) -> Rigid3:
        """All poses as a batch; identity where there is none."""
        return Rigid3.stack([Rigid3.identity() if pose is None else pose for pose in self.poses])

    def is_point(self) -> Bool[np.ndarray, "t"]:
        """Which tracks have a position."""
        return np.isfinite(self.xyz[:, 0])

    def used_observations(self) -> Int[np.ndarray, "u"]:
        """Active observations of points by registered views."""
        return np.flatnonzero(
            self.active & self.registered_mask()[self.tracks.view] & self.is_point()[self.tracks.point]
        )

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
        model = replace(self, cameras=problem.cameras, xyz=xyz)
        for k, view in enumerate(views):
            model = model.with_pose(view, problem.cam_from_world[k])
        return model


@dataclass(frozen=True, eq=False)
class Reprojections:
    """Reprojected pixels (nan behind the camera) and errors (inf there) of the observations `rows`."""

    rows: Int[np.ndarray, "u"]
    pixels: Float[np.ndarray, "u 2"]
    errors: Float[np.ndarray, "u"]


def reprojections(model: WorkingModel, rows: Int[np.ndarray, "u"] | None = None) -> Reprojections:
    """Where the model's points appear in its registered views; by default for all used observations."""
    if rows is None:
        rows = model.used_observations()
    view, point = model.tracks.view[rows], model.tracks.point[rows]
    in_cam = model.stacked_poses()[view].apply(model.xyz[point])
    pixels = np.empty((len(rows), 2))
    for c, camera in enumerate(model.cameras):
        mine = model.camera_of_view[view] == c
        pixels[mine] = image_from_cam(camera, in_cam[mine])
    errors = np.linalg.norm(pixels - model.tracks.pixels[rows], axis=1)
    return Reprojections(rows, pixels, np.nan_to_num(errors, nan=np.inf))


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
    for v in np.flatnonzero(model.registered_mask()).tolist() if views is None else views:
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
    views = tuple(View(name, int(model.camera_of_view[v]), model.poses[v]) for v, name in enumerate(graph.names))
    return Reconstruction(model.cameras, views, Points(model.xyz[is_seen], rgb), observations)
