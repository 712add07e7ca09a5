"""Reference poses and cameras of public data sets, as reconstructions without points.

A camera whose photo is known in another size than the one that is reconstructed keeps the size of its file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.opengl import CV_FROM_GL, cam_from_world_of_gl
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import nearest_rotation
from fieldstone.io.models.colmap import read_colmap
from fieldstone.io.posed.llff import read_llff
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations


def read_ground_truth(folder: Path) -> Reconstruction | None:
    """Poses from `gt_dense_cameras/*.camera` or a `colmap_ground_truth` model; None where a set has neither."""
    if (folder / "gt_dense_cameras").is_dir():
        return read_strecha(folder / "gt_dense_cameras")
    if (folder / "colmap_ground_truth").is_dir():
        return read_colmap(folder / "colmap_ground_truth")
    return None


def read_strecha(folder: Path) -> Reconstruction:
    """The laser-scanned benchmark of Strecha et al. (2008): K, distortion, R (camera to world), C, size.

    K has its origin in the centre of the first pixel.
    """
    cameras, names, poses = [], [], []
    for path in sorted(folder.glob("*.camera")):
        numbers = np.array(path.read_text().split(), dtype=float)
        K, R, C = numbers[:9].reshape(3, 3), numbers[12:21].reshape(3, 3).T, numbers[21:24]
        width, height = numbers[24:26].astype(int).tolist()
        names.append(path.name.removesuffix(".camera"))
        poses.append(Rigid3(R, -R @ C))
        cameras.append(_pinhole(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    return posed(names, cameras, poses)


def read_transforms(file: Path) -> Reconstruction:
    """A transforms.json with one camera: world from camera with the axes of OpenGL, and OPENCV intrinsics."""
    given = json.loads(file.read_text())
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    camera = Camera("OPENCV", int(given["w"]), int(given["h"]), np.array([given[key] for key in keys]))
    frames = given["frames"]
    names = [Path(frame["file_path"]).name for frame in frames]
    poses = [cam_from_world_of_gl(np.array(frame["transform_matrix"])) for frame in frames]
    return posed(names, [camera] * len(names), poses)


def read_dino(file: Path) -> Reconstruction:
    """A parameter file of the Middlebury multi-view data: name, K, R and t with P = K [R t], by rows; 640 x 480."""
    names, cameras, poses = [], [], []
    for line in file.read_text().splitlines()[1:]:
        name, *rest = line.split()
        numbers = np.array(rest, dtype=float)
        K = numbers[:9].reshape(3, 3)
        names.append(name)
        cameras.append(_pinhole(640, 480, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
        poses.append(Rigid3(nearest_rotation(numbers[9:18].reshape(3, 3)), numbers[18:21]))
    return posed(names, cameras, poses)


def read_image_matching(folder: Path) -> Reconstruction:
    """Files `calibration_NAME.h5` of the Image Matching Challenge: K, R and T, world to camera.

    Raises:
        RuntimeError: h5py is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise RuntimeError(f"{folder} holds HDF5 files; install h5py to read them: pip install h5py") from error
    names, cameras, poses = [], [], []
    for path in sorted(folder.glob("calibration_*.h5")):
        with h5py.File(path) as file:
            K, R, T = (np.array(file[key], dtype=float) for key in ("K", "R", "T"))
        names.append(path.stem.removeprefix("calibration_") + ".jpg")
        cx, cy = float(K[0, 2]), float(K[1, 2])  # the middle of the photo
        cameras.append(_pinhole(round(2 * cx), round(2 * cy), float(K[0, 0]), float(K[1, 1]), cx, cy))
        poses.append(Rigid3(nearest_rotation(R), T.reshape(3)))
    return posed(names, cameras, poses)


def read_pseudo_truth(file: Path) -> Reconstruction:
    """Loose poses of internet photos: world from camera with our axes, then height, width and focal length."""
    frames = json.loads(file.read_text())["frames"]
    cameras, poses = [], []
    for frame in frames:
        height, width, focal = frame["height_width_focal"]
        matrix = np.array(frame["world_from_cam"])
        cameras.append(_pinhole(int(width), int(height), focal, focal, 0.5 * width, 0.5 * height))
        poses.append(Rigid3(nearest_rotation(matrix[:3, :3]), matrix[:3, 3]).inverse())
    return posed([frame["name"] for frame in frames], cameras, poses)


def read_made_poses(file: Path, focal_px: Sequence[float]) -> Reconstruction:
    """Poses of made photos, `cam_from_world` as R and the centre.

    Args:
        file: Lies beside the photos.
        focal_px: Of the photos in turn: the first photo has the first, and it starts again after the last.
    """
    frames = json.loads(file.read_text())["cam_from_world"]
    cameras, poses = [], []
    for k, frame in enumerate(frames):
        with Image.open(file.parent / frame["name"]) as photo:
            width, height = photo.size
        f = focal_px[k % len(focal_px)]
        R = nearest_rotation(np.array(frame["R"]))
        cameras.append(_pinhole(width, height, f, f, 0.5 * width, 0.5 * height))
        poses.append(Rigid3(R, -R @ np.array(frame["center"])))
    return posed([frame["name"] for frame in frames], cameras, poses)


def read_bundler(file: Path, photos: Path) -> Reconstruction:
    """The cameras of a Bundler file for the photos of a folder in their order: f, k1, k2, then R and t.

    Its cameras look along -z, as those of OpenGL.
    """
    lines = file.read_text().splitlines()
    paths = sorted(photos.glob("*.jpg"))
    if int(lines[1].split()[0]) != len(paths):
        raise ValueError(f"{file} has {lines[1].split()[0]} cameras, {photos} {len(paths)} photos")
    cameras, poses = [], []
    for k, path in enumerate(paths):
        numbers = np.array(" ".join(lines[2 + 5 * k : 7 + 5 * k]).split(), dtype=float)
        with Image.open(path) as photo:
            width, height = photo.size
        f, k1, k2 = numbers[:3].tolist()
        cameras.append(Camera("RADIAL", width, height, np.array([f, 0.5 * width, 0.5 * height, k1, k2])))
        poses.append(Rigid3(CV_FROM_GL @ nearest_rotation(numbers[3:12].reshape(3, 3)), CV_FROM_GL @ numbers[12:15]))
    return posed([path.name for path in paths], cameras, poses)


def read_poses_bounds(folder: Path) -> Reconstruction:
    """The `poses_bounds.npy` of an LLFF folder."""
    photos = read_llff(folder).photos
    cameras = [photos.cameras[c] for c in photos.camera_of_photo.tolist()]
    return posed(photos.names, cameras, [photos.cam_from_world[k] for k in range(len(photos.names))])


def posed(names: Sequence[str], cameras: Sequence[Camera], poses: Sequence[Rigid3]) -> Reconstruction:
    """Views with poses, a camera each, and nothing else."""
    views = tuple(View(name, k, pose) for k, (name, pose) in enumerate(zip(names, poses, strict=True)))
    no_points = Points(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8))
    return Reconstruction(tuple(cameras), views, no_points, Observations.empty())


def _pinhole(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
    return Camera("PINHOLE", width, height, np.array([fx, fy, cx, cy]))
