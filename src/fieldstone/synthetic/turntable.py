"""Photos of an object on a turntable, in front of a background that does not turn, with the true poses and masks.

The camera stands still and the object turns: for the object that is a camera on a circle around it. What lies behind it
is at the same pixels in every photo, whatever the true poses are.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.synthetic import materials
from fieldstone.synthetic.construction import Builder, Surface
from fieldstone.synthetic.light import level_camera
from fieldstone.synthetic.noise import fractal
from fieldstone.synthetic.photos import House, PhotoOptions, painted, photograph, see

OBJECT_CENTER = np.array([0.0, 0.0, 0.9])
PLATE_CORNERS = 16
FINER = 2
"""Photos are drawn this many times as large, put together there, and reduced."""


@dataclass(frozen=True)
class TurntableOptions:
    """How the object is photographed."""

    num_photos: int = 24
    """On a full turn."""
    width: int = 640
    height: int = 480
    focal_px: float = 560.0
    distance: float = 4.6
    """From the camera to the middle of the object, in its units: it is about two high."""
    elevation_deg: float = 22.0
    """Of the camera above the middle of the object."""
    texel: float = 0.012
    noise: float = 1.0
    """Standard deviation of the sensor noise, in grey levels."""

    def camera(self, finer: int = 1) -> Camera:
        """The one camera of all photos, or that of photos so many times as large."""
        params = finer * np.array([self.focal_px, self.width / 2, self.height / 2])
        return Camera("SIMPLE_PINHOLE", finer * self.width, finer * self.height, params)


@dataclass(frozen=True, eq=False)
class TurntablePhotos:
    """Photos and what is true of them."""

    camera: Camera
    poses: tuple[Rigid3, ...]
    """`cam_from_object`."""
    images: tuple[UInt8[np.ndarray, "h w 3"], ...]
    alphas: tuple[UInt8[np.ndarray, "h w"], ...]
    """How much of each pixel shows the object or the plate that turns with it."""


def photograph_turntable(options: TurntableOptions, rng: np.random.Generator, *, threads: int = 2) -> TurntablePhotos:
    """One turn of the object; the same for any number of threads."""
    thing = painted(build_object(), OBJECT_CENTER, options.texel, rng, threads=threads)
    behind = _background(options, rng)
    poses, streams = turntable_poses(options), rng.spawn(options.num_photos)
    with ThreadPoolExecutor(threads) as pool:
        made = list(pool.map(lambda k: _photo(thing, behind, poses[k], options, streams[k]), range(len(poses))))
    images, alphas = zip(*made, strict=True)
    return TurntablePhotos(options.camera(), tuple(poses), images, alphas)


def turntable_poses(options: TurntableOptions) -> list[Rigid3]:
    """`cam_from_object` on a circle, exactly level."""
    elevation = np.deg2rad(options.elevation_deg)
    azimuths = 2 * np.pi * np.arange(options.num_photos) / options.num_photos
    around = [
        np.array([np.cos(a) * np.cos(elevation), np.sin(a) * np.cos(elevation), np.sin(elevation)]) for a in azimuths
    ]
    return [level_camera(OBJECT_CENTER + options.distance * a, OBJECT_CENTER) for a in around]


def build_object() -> list[Surface]:
    """A heap of blocks, no two sides alike, on a wooden plate."""
    build = Builder()
    angle = 2 * np.pi * np.arange(PLATE_CORNERS) / PLATE_CORNERS
    radius, side = 1.55, 3.2
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cuts = np.column_stack([normals, radius + normals @ [side / 2, side / 2]])
    wood = materials.planks("8a6a45 7a5a38 97774f", 0.12)
    build.quad((-side / 2, -side / 2, 0.0), (1, 0, 0), (0, 1, 0), side, side, wood, cuts=cuts)
    build.box((-0.75, -0.55, 0.0), (0.65, 0.6, 0.8), materials.brick, materials.flagstones, turn=0.2)
    build.box((-0.95, -0.2, 0.0), (-0.55, 0.5, 1.25), materials.fieldstone, turn=-0.3)
    build.box((-0.3, -0.35, 0.8), (0.5, 0.4, 1.5), materials.sandstone, materials.tiles, turn=0.5)
    build.box((0.05, -0.2, 1.5), (0.4, 0.25, 1.9), materials.planks("1f5c57 c8b560 8d4a33", 0.1), turn=0.1)
    build.box((0.5, -1.0, 0.0), (0.95, -0.55, 0.55), materials.fieldstone, materials.gravel, turn=0.6)
    build.box((0.6, 0.45, 0.0), (1.05, 0.95, 0.4), materials.planks("5f7f8c 567685 6a8a96", 0.08), turn=-0.4)
    return build.surfaces


def _background(options: TurntableOptions, rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    """A pasted wall and a table, as grey levels of the large picture."""
    height, width = FINER * options.height, FINER * options.width
    texel = 4.0 / width
    a, b = np.meshgrid(np.arange(width, dtype=np.float32) * texel, np.arange(height, dtype=np.float32) * texel)
    wall = materials.fieldstone(a, b, rng)
    stain = fractal((height, width), texel, 0.5, 6, rng, gain=0.7)
    levels = 255.0 * np.clip(wall * (0.9 + 0.25 * stain[..., None]), 0.0, 1.0) ** (1 / 2.2)
    return levels.astype(np.float32)


def _photo(
    thing: House,
    behind: Float[np.ndarray, "H W 3"],
    cam_from_object: Rigid3,
    options: TurntableOptions,
    rng: np.random.Generator,
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """The object before the background, and its opacity."""
    fine = options.camera(FINER)
    drawn = PhotoOptions(width=fine.width, height=fine.height, samples_per_axis=1, noise=0.0)
    object_levels = photograph(thing, fine, cam_from_object, drawn, rng)
    covers = (see(thing, fine, cam_from_object).patch >= 0).astype(np.float32)
    large = behind + covers[..., None] * (object_levels - behind)
    size = options.width, options.height
    levels, alpha = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (large, covers))
    levels += options.noise * rng.standard_normal(levels.shape, dtype=np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8), np.rint(255.0 * alpha).astype(np.uint8)
