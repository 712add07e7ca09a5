"""The house of the demo as an object before nothing, in the Blender format: a scene for `benchmarks.field`.

    python -m benchmarks.blender_house OUT [--size 800] [--distance 23.8]

100 training views from all over the upper half sphere and 20 test views on a climbing ring, with alpha, as in the
synthetic scenes of `mildenhall2020`. At 23.8 m the house fills 29 % of the pixels, at 17 m 59 %.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.geometry.camera import Camera, plane_from_image, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import write_photo
from fieldstone.scene.rays import pixel_centers
from fieldstone.synthetic.building import build_house
from fieldstone.synthetic.light import level_camera
from fieldstone.synthetic.patches import look, shade
from fieldstone.synthetic.photos import House, develop, make_house

ANGLE_X = 0.6911
"""Horizontal field of view, in radians."""

TEXEL = 0.014
"""Size of the finest texture detail, in metres."""

MIDDLE, RADIUS = np.array([0.3, -0.2, 3.6]), 7.5
"""What is looked at; surfaces further from it than RADIUS along x or y are left out, as all leaves are."""

DISTANCE = 4.0
"""Of the cameras from the origin, in the unit of the files."""

NUM_TRAIN, NUM_TEST, SAMPLES = 100, 20, 2
"""Views, and rays per pixel and axis."""


def main() -> None:
    """Write the scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", type=int, default=800, help="pixels along each side")
    parser.add_argument("--distance", type=float, default=23.8, help="of the cameras from the house, in metres")
    arguments = parser.parse_args()
    house = bare_house(seed=0)
    focal = 0.5 * arguments.size / np.tan(0.5 * ANGLE_X)
    camera = Camera("SIMPLE_PINHOLE", arguments.size, arguments.size, np.array([focal, *[0.5 * arguments.size] * 2]))
    scale = DISTANCE / arguments.distance
    with ThreadPoolExecutor(os.cpu_count()) as executor:
        for split, positions in {"train": train_positions(seed=5), "test": test_positions()}.items():
            poses = [level_camera(MIDDLE + arguments.distance * p, MIDDLE) for p in positions]

            def take(k: int, split: str = split, poses: list[Rigid3] = poses) -> dict[str, object]:
                write_photo(arguments.out / split / f"r_{k}.png", photograph(house, camera, poses[k]))
                return {"file_path": f"./{split}/r_{k}", "transform_matrix": blender_matrix(poses[k], scale).tolist()}

            frames = list(executor.map(take, range(len(poses))))
            document = {"camera_angle_x": ANGLE_X, "frames": frames}
            (arguments.out / f"transforms_{split}.json").write_text(json.dumps(document))


def bare_house(seed: int) -> House:
    """The house of the demo without garden and plants."""
    surfaces = build_house(np.random.default_rng(seed))
    house = make_house(TEXEL, np.random.default_rng(seed))
    far = [np.abs(s.patch.corners()[:, :2] - MIDDLE[:2]).max() > RADIUS for s in surfaces]
    kept = [k for k, s in enumerate(surfaces) if s.leaf is None and not far[k]]
    patches, textures = tuple(house.patches[k] for k in kept), tuple(house.textures[k] for k in kept)
    return House(patches, textures, house.tints[kept], house.sky)


def train_positions(seed: int) -> Iterator[Float[np.ndarray, "3"]]:
    """Directions drawn evenly from the upper half sphere."""
    rng = np.random.default_rng(seed)
    for _ in range(NUM_TRAIN):
        yield direction(rng.uniform(0, 2 * np.pi), np.arcsin(rng.uniform(0.02, 0.98)))


def test_positions() -> Iterator[Float[np.ndarray, "3"]]:
    """Directions once around, from 10 to 48 degrees up."""
    for k in range(NUM_TEST):
        yield direction(2 * np.pi * k / NUM_TEST + 0.05, np.deg2rad(10 + 40 * k / NUM_TEST))


def direction(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Unit vector of two angles in radians."""
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def photograph(house: House, camera: Camera, cam_from_world: Rigid3) -> UInt8[np.ndarray, "h w 4"]:
    """The house before nothing: sRGB and alpha, not premultiplied."""
    fine = rescale(camera, camera.width * SAMPLES, camera.height * SAMPLES)
    plane = plane_from_image(fine, pixel_centers(fine.width, fine.height))
    x, y = np.ascontiguousarray(plane.T).reshape(2, fine.height, fine.width)
    seen = look(house.patches, cam_from_world, x, y)
    color = shade(house.patches, house.textures, house.tints, seen, cam_from_world, x, y, 1.0 / float(fine.focal[0]))
    alpha = (seen.patch >= 0).astype(np.float32)[..., None]
    size = (camera.width, camera.height)
    sums = cv2.resize(np.concatenate([develop(color) * alpha, alpha], axis=2), size, interpolation=cv2.INTER_AREA)
    rgb = sums[..., :3] / np.maximum(sums[..., 3:], 1e-6)
    return np.rint(255 * np.clip(np.concatenate([rgb, sums[..., 3:]], axis=2), 0, 1)).astype(np.uint8)


def blender_matrix(cam_from_world: Rigid3, scale: float) -> Float[np.ndarray, "4 4"]:
    """Camera to world as Blender has it: y up, z backward, lengths about MIDDLE times `scale`."""
    matrix = cam_from_world.inverse().matrix()
    matrix[:3, :3] = matrix[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = scale * (matrix[:3, 3] - MIDDLE)
    return matrix


if __name__ == "__main__":
    main()
