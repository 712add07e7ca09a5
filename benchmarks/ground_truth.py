"""Reference poses of public data sets, as reconstructions without points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.models.colmap import read_colmap
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
    cameras, views = [], []
    for path in sorted(folder.glob("*.camera")):
        numbers = np.array(path.read_text().split(), dtype=float)
        K, R, C = numbers[:9].reshape(3, 3), numbers[12:21].reshape(3, 3).T, numbers[21:24]
        width, height = numbers[24:26].astype(int).tolist()
        params = np.array([K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5])
        views.append(View(path.name.removesuffix(".camera"), len(cameras), Rigid3(R, -R @ C)))
        cameras.append(Camera("PINHOLE", width, height, params))
    return Reconstruction(
        tuple(cameras),
        tuple(views),
        Points(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)),
        Observations.empty(),
    )
