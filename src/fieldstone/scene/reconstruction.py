"""Cameras, posed views, points and what connects them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.tracks import Observations


@dataclass(frozen=True, eq=False)
class View:
    """One photo: its file name, the index of its camera, and its pose, None while it is not registered."""

    name: str
    camera: int
    cam_from_world: Rigid3 | None


@dataclass(frozen=True, eq=False)
class Points:
    """World points and their sRGB colours."""

    xyz: Float[np.ndarray, "p 3"]
    rgb: UInt8[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Cameras (shared between views by index), views, points, and the observations that tie points to views."""

    cameras: tuple[Camera, ...]
    views: tuple[View, ...]
    points: Points
    observations: Observations

    def __post_init__(self) -> None:
        for view in self.views:
            if not 0 <= view.camera < len(self.cameras):
                raise ValueError(f"view {view.name!r} has camera {view.camera} of {len(self.cameras)}")
        if len(self.observations) and int(self.observations.point[-1]) >= len(self.points):
            raise ValueError(f"an observation names point {int(self.observations.point[-1])} of {len(self.points)}")

    def registered(self) -> Int[np.ndarray, "r"]:
        """Indices of the views that have a pose."""
        return np.array([i for i, view in enumerate(self.views) if view.cam_from_world is not None], dtype=np.int64)

    def camera_of(self, view: int) -> Camera:
        """The camera of a view."""
        return self.cameras[self.views[view].camera]

    def pose_of(self, view: int) -> Rigid3:
        """`cam_from_world` of a registered view.

        Raises:
            ValueError: The view is not registered.
        """
        pose = self.views[view].cam_from_world
        if pose is None:
            raise ValueError(f"view {self.views[view].name!r} is not registered")
        return pose

    def camera_centers(self) -> Float[np.ndarray, "r 3"]:
        """Camera positions in the world, of the registered views in their order."""
        return np.array([self.pose_of(i).target_origin_in_source() for i in self.registered().tolist()]).reshape(-1, 3)

    def reprojections(self) -> Float[np.ndarray, "o 2"]:
        """Pixel at which each observed point appears in its view; nan where it is behind the camera."""
        out = np.full((len(self.observations), 2), np.nan)
        for i in self.registered().tolist():
            rows = self.observations.view == i
            points = self.points.xyz[self.observations.point[rows]]
            out[rows] = image_from_cam(self.camera_of(i), self.pose_of(i).apply(points))
        return out

    def reprojection_errors(self) -> Float[np.ndarray, "o"]:
        """Distance in pixels between each observation and its reprojection; nan behind the camera."""
        return np.linalg.norm(self.reprojections() - self.observations.pixels, axis=1)

    def to_pycolmap(self) -> Any:
        """The model as a `pycolmap.Reconstruction`: what `write_colmap` writes, without a file.

        Ids are indices plus one, with one rig per camera and one frame per registered view. The keypoints of an image
        are the observed ones, in their order. Each point carries its mean reprojection error in pixels.

        Raises:
            InputError: pycolmap is not installed.
            ValueError: An observed view has no pose, or one keypoint shows two points.
        """
        try:
            pycolmap = import_module("pycolmap")
        except ImportError as error:
            raise InputError("pycolmap is not installed; install it: pip install pycolmap") from error
        out = pycolmap.Reconstruction()
        registered = self.registered().tolist()
        for c in sorted({self.views[v].camera for v in registered}):
            camera = self.cameras[c]
            size = {"width": camera.width, "height": camera.height}
            out.add_camera_with_trivial_rig(
                pycolmap.Camera(model=camera.model, params=camera.params, camera_id=c + 1, **size)
            )
        keypoint_in_image = self.keypoints_among_observed()
        for v in registered:
            rows = self.observations.view == v
            pixels = np.empty((int(rows.sum()), 2))
            pixels[keypoint_in_image[rows]] = self.observations.pixels[rows]
            view, pose = self.views[v], self.pose_of(v)
            image = pycolmap.Image(name=view.name, keypoints=pixels, camera_id=view.camera + 1, image_id=v + 1)
            out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose.R), pose.t))
        first_row = np.searchsorted(self.observations.point, np.arange(len(self.points) + 1))
        for p, (xyz, rgb) in enumerate(zip(self.points.xyz, self.points.rgb, strict=True)):
            track = pycolmap.Track()
            for k in range(first_row[p], first_row[p + 1]):
                track.add_element(int(self.observations.view[k]) + 1, int(keypoint_in_image[k]))
            out.add_point3D_with_id(p + 1, pycolmap.Point3D(xyz=xyz, color=rgb, track=track))
        out.update_point_3d_errors()
        return out

    def keypoints_among_observed(self) -> Int[np.ndarray, "o"]:
        """Number of each observation's keypoint among the observed keypoints of its view.

        Raises:
            ValueError: An observed view has no pose, or one keypoint shows two points.
        """
        observations = self.observations
        if not np.isin(observations.view, self.registered()).all():
            raise ValueError("an observation belongs to a view that is not registered")
        number = np.empty(len(observations), dtype=np.int64)
        for v in self.registered().tolist():
            rows = np.flatnonzero(observations.view == v)
            observed, number[rows] = np.unique(observations.keypoint[rows], return_inverse=True)
            if len(observed) < len(rows):
                raise ValueError(f"a keypoint of {self.views[v].name} shows two points")
        return number
