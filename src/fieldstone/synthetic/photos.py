"""Photos of a small procedural house, with the true cameras, depths and points.

They are the input of `fieldstone demo` and of the end-to-end tests: nothing needs to be downloaded, and the answer
is known. The house is ray-cast, see `patches`; light and shadow are baked, see `light`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from PIL.ExifTags import IFD, Base

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.scene.rays import pixel_centers
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic import materials
from fieldstone.synthetic.building import NUM_LEAVES, build_house
from fieldstone.synthetic.construction import Surface
from fieldstone.synthetic.light import Lighting, Sky, level_camera
from fieldstone.synthetic.patches import Patch, Seen, Texture, look, shade

TRUTH_FILE = "truth.json"
FULL_FRAME_DIAGONAL_MM = float(np.hypot(36.0, 24.0))
HOUSE_CENTER = np.array([0.5, -0.2, 3.1])
EXPOSURE = 0.62
HAZE_DISTANCE = 220.0


@dataclass(frozen=True)
class PhotoOptions:
    """How many photos of what size are taken, and from where."""

    num_photos: int = 14
    width: int = 640
    height: int = 480
    focal_35mm: int = 29
    """Focal length as EXIF states it: millimetres on a 36 x 24 mm film of the same diagonal."""
    radial_distortion: float = 0.0
    """Coefficient k of the SIMPLE_RADIAL model."""
    arc_deg: float = 150.0
    """The cameras stand on an arc of this angle around the front of the house."""
    distance: float = 14.0
    """Mean distance to the middle of the house, in metres."""
    samples_per_axis: int = 2
    """Rays per pixel and axis (anti-aliasing)."""
    texel: float = 0.014
    """Size of the finest texture detail, in metres."""
    noise: float = 1.0
    """Standard deviation of the sensor noise, in grey levels."""

    def __post_init__(self) -> None:
        if self.num_photos < 1:
            raise ValueError(f"num_photos must be at least 1, got {self.num_photos}")
        if min(self.width, self.height) < 8:
            raise ValueError(f"photos must be at least 8 x 8 pixels, got {self.width} x {self.height}")
        if self.focal_35mm < 1 or self.samples_per_axis < 1:
            raise ValueError("focal_35mm and samples_per_axis must be at least 1")

    def camera(self) -> Camera:
        """The one camera of all photos."""
        focal = self.focal_35mm / FULL_FRAME_DIAGONAL_MM * float(np.hypot(self.width, self.height))
        params = np.array([focal, self.width / 2, self.height / 2, self.radial_distortion])
        if self.radial_distortion == 0.0:
            return Camera("SIMPLE_PINHOLE", self.width, self.height, params[:3])
        return Camera("SIMPLE_RADIAL", self.width, self.height, params)


@dataclass(frozen=True, eq=False)
class House:
    """The house, or whatever surfaces there are, ready to be photographed."""

    patches: tuple[Patch, ...]
    textures: tuple[Texture, ...]
    tints: Float[np.ndarray, "p 3"]
    sky: Sky


@dataclass(frozen=True, eq=False)
class SyntheticPhotos:
    """Photos and what is true of them."""

    truth: Reconstruction
    """Cameras, poses, and exact surface points with their exact observations."""
    images: list[UInt8[np.ndarray, "h w 3"]]
    house: House


def make_house(texel: float, rng: np.random.Generator, *, threads: int = 2) -> House:
    """Build the house, paint it and light it; each surface draws from its own stream."""
    return painted(build_house(rng), HOUSE_CENTER, texel, rng, threads=threads)


def painted(
    surfaces: Sequence[Surface], center: Float[np.ndarray, "3"], texel: float, rng: np.random.Generator, *, threads: int
) -> House:
    """Surfaces ready to be photographed, in light that is exact near `center`."""
    sky = Sky.draw(rng)
    patches = tuple(s.patch for s in surfaces)
    lighting = Lighting.of(patches, center)
    solid = [k for k, s in enumerate(surfaces) if s.leaf is None]
    foliage = [k for k, s in enumerate(surfaces) if s.leaf is not None]
    streams = rng.spawn(len(solid))
    leaves = [_leaf_texture(texel, rng) for _ in range(NUM_LEAVES)] if foliage else []
    with ThreadPoolExecutor(threads) as pool:
        work = zip(solid, streams, strict=True)
        jobs = [pool.submit(_bake, surfaces[k], lighting, texel, stream) for k, stream in work]
        baked = {k: job.result() for k, job in zip(solid, jobs, strict=True)}
    textures = tuple(baked[k] if s.leaf is None else leaves[s.leaf] for k, s in enumerate(surfaces))
    tints = np.ones((len(surfaces), 3), dtype=np.float32)
    if foliage:
        tints[foliage] = lighting.on_leaves(np.array([patches[k].corners().mean(axis=0) for k in foliage]))
    return House(patches, textures, tints, sky)


def _texels(size_a: float, size_b: float, step: float) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Centres of square texels of exactly `step`; the last row and column may overhang a little."""
    width, height = max(round(size_a / step), 2), max(round(size_b / step), 2)
    a, b = np.meshgrid((np.arange(width) + 0.5) * step, (np.arange(height) + 0.5) * step)
    return a.astype(np.float32), b.astype(np.float32)


def _bake(surface: Surface, lighting: Lighting, texel: float, rng: np.random.Generator) -> Texture:
    """Albedo times light, on the texels of a patch."""
    patch, step = surface.patch, texel * surface.coarse
    albedo = surface.material(*_texels(patch.size_a, patch.size_b, step), rng)
    light = lighting.on(patch, max(4.0 * step, 0.04))
    return Texture.build(albedo * cv2.resize(light, albedo.shape[1::-1], interpolation=cv2.INTER_LINEAR), step)


def _leaf_texture(texel: float, rng: np.random.Generator) -> Texture:
    """Albedo of a bunch of leaves, large enough for every card."""
    step = max(texel, 0.012) * 1.5
    return Texture.build(materials.leaves(*_texels(1.1, 1.1, step), rng), step)


def make_photos(options: PhotoOptions, rng: np.random.Generator, *, threads: int = 2) -> SyntheticPhotos:
    """Photograph the house; the same for any number of threads."""
    house = make_house(options.texel, rng, threads=threads)
    camera, poses = options.camera(), camera_arc(options, rng)
    streams = rng.spawn(options.num_photos)
    with ThreadPoolExecutor(threads) as pool:
        images = list(
            pool.map(lambda p: photograph(house, camera, p[0], options, p[1]), zip(poses, streams, strict=True))
        )
    return SyntheticPhotos(_truth(house, camera, poses, images, rng), images, house)


def camera_arc(options: PhotoOptions, rng: np.random.Generator) -> list[Rigid3]:
    """cam_from_world on an arc around the front, at several heights and distances, never quite level."""
    n = options.num_photos
    half = np.deg2rad(options.arc_deg) / 2
    poses = []
    for k, angle in enumerate(np.linspace(-half, half, n) if n > 1 else [0.0]):
        azimuth = angle + rng.uniform(-0.1, 0.1) * half / n
        distance = options.distance * (1.0 + 0.06 * np.sin(2.1 * k) + rng.uniform(-0.02, 0.02))
        height = 3.1 + 1.7 * np.sin(1.3 * k + 0.5)
        position = np.array([0.5 + distance * np.sin(azimuth), -0.2 - distance * np.cos(azimuth), height])
        target = HOUSE_CENTER + rng.uniform(-0.35, 0.35, size=3) + [0.0, 0.0, 0.45]
        poses.append(level_camera(position, target, roll=float(rng.normal(0.0, 0.015))))
    return poses


def photograph(
    house: House, camera: Camera, cam_from_world: Rigid3, options: PhotoOptions, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """One photo, anti-aliased, in sRGB."""
    n = options.samples_per_axis
    x, y = _sample_grid(camera, n)
    seen = look(house.patches, cam_from_world, x, y)
    angle = 1.0 / (n * float(np.mean(camera.focal)))
    color = shade(house.patches, house.textures, house.tints, seen, cam_from_world, x, y, angle)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32) @ cam_from_world.R.astype(np.float32)
    length = np.linalg.norm(rays, axis=-1)
    sky = seen.patch < 0
    color[sky] = house.sky.color(rays[sky] / length[sky][:, None])
    haze = 1.0 - np.exp(-np.where(sky, 0.0, seen.depth * length) / HAZE_DISTANCE).astype(np.float32)
    color += np.where(sky, 0.0, haze)[..., None].astype(np.float32) * (HAZE_COLOR - color)
    if n > 1:
        color = cv2.resize(color, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    levels = 255.0 * develop(color) + options.noise * rng.standard_normal(color.shape, dtype=np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


HAZE_COLOR = np.array([0.62, 0.72, 0.80], dtype=np.float32)


def develop(color: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """sRGB in [0, 1] of linear light: exposure, a soft shoulder for the highlights, the sRGB curve."""
    light = EXPOSURE * color
    shoulder = light * (1.0 + light / 3.2) / (1.0 + light)
    bright = np.clip(1.12 * shoulder, 0.0, 1.0)
    return np.where(bright <= 0.0031308, 12.92 * bright, 1.055 * np.maximum(bright, 1e-9) ** (1 / 2.4) - 0.055)


def _sample_grid(camera: Camera, per_axis: int) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Points of the plane z = 1 under the samples of all pixels."""
    width, height = camera.width * per_axis, camera.height * per_axis
    plane = plane_from_image(camera, pixel_centers(width, height) / per_axis)
    x, y = np.ascontiguousarray(plane.T).reshape(2, height, width)
    return x, y


def see(house: House, camera: Camera, cam_from_world: Rigid3) -> Seen:
    """Exact patch and depth along z at the centre of every pixel: the oracle for depth maps."""
    return look(house.patches, cam_from_world, *_sample_grid(camera, 1))


def surface_points(camera: Camera, cam_from_world: Rigid3, seen: Seen) -> Float[np.ndarray, "h w 3"]:
    """Exact world point at the centre of every pixel; not finite where it shows the sky."""
    x, y = _sample_grid(camera, 1)
    points_in_cam = np.stack([x, y, np.ones_like(x)], axis=-1) * seen.depth[..., None]
    return cam_from_world.inverse().apply(points_in_cam)


def _truth(
    house: House,
    camera: Camera,
    poses: Sequence[Rigid3],
    images: Sequence[UInt8[np.ndarray, "h w 3"]],
    rng: np.random.Generator,
    points_per_photo: int = 150,
) -> Reconstruction:
    """Surface points drawn from every photo, and all photos in which each of them is visible."""
    views = [see(house, camera, pose) for pose in poses]
    xyz, rgb = [], []
    for pose, seen, image in zip(poses, views, images, strict=True):
        solid = np.flatnonzero(seen.depth.ravel() < 40.0)
        chosen = np.sort(rng.choice(solid, size=min(points_per_photo, len(solid)), replace=False))
        xyz.append(surface_points(camera, pose, seen).reshape(-1, 3)[chosen])
        rgb.append(image.reshape(-1, 3)[chosen])
    points = Points(np.concatenate(xyz), np.concatenate(rgb))
    point, view, pixels = [], [], []
    for index, (pose, seen) in enumerate(zip(poses, views, strict=True)):
        at = image_from_cam(camera, pose.apply(points.xyz))
        inside = np.all((at > 0) & (at < [camera.width, camera.height]), axis=1)
        visible = np.flatnonzero(inside)
        column, row = at[visible].astype(np.int64).T
        depth = pose.apply(points.xyz[visible])[:, 2]
        visible = visible[np.abs(seen.depth[row, column] - depth) < 0.02 * depth]
        point.append(visible)
        view.append(np.full(len(visible), index))
        pixels.append(at[visible])
    point, view, pixels = np.concatenate(point), np.concatenate(view), np.concatenate(pixels)
    order = np.lexsort((view, point))
    observations = Observations(view[order], point[order].copy(), point[order], pixels[order])
    posed = tuple(View(f"house_{k:02d}.jpg", 0, pose) for k, pose in enumerate(poses))
    return Reconstruction((camera,), posed, points, observations)


def write_photos(photos: SyntheticPhotos, folder: Path, options: PhotoOptions, *, quality: int = 95) -> list[Path]:
    """Write JPEG files with EXIF (camera name, focal length) and `truth.json`; returns the paths of the photos."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for view, image in zip(photos.truth.views, photos.images, strict=True):
        exif = Image.Exif()
        exif[Base.Make], exif[Base.Model] = "fieldstone", "synthetic house"
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = options.focal_35mm
        path = folder / view.name
        Image.fromarray(image).save(path, quality=quality, subsampling=0, exif=exif)
        paths.append(path)
    write_truth(photos.truth, folder / TRUTH_FILE)
    return paths


def write_truth(truth: Reconstruction, path: Path) -> None:
    """Cameras and poses as JSON, exact to the last bit."""
    document = {
        "frames": "cam_from_world; camera x right, y down, z forward; pixels from the corner; metres",
        "cameras": [
            {"model": c.model, "width": c.width, "height": c.height, "params": c.params.tolist()} for c in truth.cameras
        ],
        "views": [
            {
                "name": v.name,
                "camera": v.camera,
                "R": truth.pose_of(i).R.tolist(),
                "t": truth.pose_of(i).t.tolist(),
            }
            for i, v in enumerate(truth.views)
        ],
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_truth(path: Path) -> Reconstruction:
    """True cameras and poses of synthetic photos, without points.

    Raises:
        InputError: The file is missing or not one that `write_truth` wrote.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        cameras = tuple(
            Camera(c["model"], c["width"], c["height"], np.array(c["params"], dtype=np.float64))
            for c in document["cameras"]
        )
        views = tuple(
            View(v["name"], v["camera"], Rigid3(np.array(v["R"], dtype=np.float64), np.array(v["t"], dtype=np.float64)))
            for v in document["views"]
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not the truth file of synthetic photos ({error}); make the photos again") from error
    empty = Points(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8))
    return Reconstruction(cameras, views, empty, Observations.empty())
