"""Small scenes for the tests of the grid field: a ball photographed from around, and a field with random values."""

import numpy as np

from fieldstone.evaluate.image_metrics import psnr
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.space import box_space
from fieldstone.field.grid.decoder import decoder_width, initial_decoder
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.layout import grid_layout
from fieldstone.field.grid.occupancy import full_box
from fieldstone.field.grid_training.plan import GridPlan, Schedule
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.photos import DecodedPhotos, posed_photos
from fieldstone.scene.rays import rays_from_view

FRAME = FieldFrame(Sim3(1.0, np.eye(3), np.zeros(3)), 2.0, 6.0, np.ones(3))
CAMERA = Camera("SIMPLE_PINHOLE", 40, 32, np.array([45.0, 20.0, 16.0]))
RADIUS = 0.8


def photographs(camera, poses, pixels, names=None, keep=None):
    """Photos of one camera."""
    names = names or [f"{k}" for k in range(len(poses))]
    table = posed_photos(names, [camera], np.zeros(len(poses), dtype=np.int64), Rigid3.stack(list(poses)))
    return DecodedPhotos(table, tuple(pixels), tuple(keep or [None] * len(poses)))


def ball_photos(n=8, camera=CAMERA, heights=(0.3, 1.6, -1.2)):
    """Photos of an opaque ball at the origin, coloured by its normal, with alpha."""
    angles = 2 * np.pi * np.arange(n) / n
    return ball_photos_from(
        camera, [np.array([3.2 * np.cos(a), 3.2 * np.sin(a), heights[k % len(heights)]]) for k, a in enumerate(angles)]
    )


def ball_photos_from(camera, places):
    """Photos of the ball from some places."""
    poses = [look_at(place, np.zeros(3), np.array([0.0, 0, 1])) for place in places]
    return photographs(
        camera, poses, [ball_pixels(camera, pose) for pose in poses], [f"r_{k}" for k in range(len(poses))]
    )


def ball_pixels(camera, pose):
    """What a camera sees of the ball, RGBA."""
    rays = rays_from_view(camera, pose)
    b = np.sum(rays.origins * rays.directions, axis=1)
    discriminant = b**2 - np.sum(rays.origins**2, axis=1) + RADIUS**2
    normals = rays.origins + (-b - np.sqrt(np.maximum(discriminant, 0)))[:, None] * rays.directions
    rgba = np.concatenate([0.5 + 0.5 * normals, (discriminant > 0)[:, None]], axis=1)
    return np.rint(255 * np.clip(rgba, 0, 1)).astype(np.uint8).reshape(camera.height, camera.width, 4)


def psnr_of_one_color(photos, photo, background=FRAME.background):
    """What the best single colour comes to, in dB: who learns something of the photo is above it."""
    shown = photos.composited(photo, background)
    return psnr(np.broadcast_to(shown.mean(axis=(0, 1)), shown.shape), shown)


THIRD_OF_ERROR_DB = 20 * np.log10(3)
"""What a field that has learned a scene is asked for: at most a third of the error of the best single colour."""


def random_field(rng, resolutions=(3, 6, 12), max_levels=4, density_bias=0.0):
    """A field with density everywhere."""
    occupancy = full_box(np.array([-1.0, -0.7, -0.5]), np.array([2.0, 1.5, 1.0]), 8)
    layout = grid_layout(occupancy.extent, resolutions)
    table = rng.normal(scale=0.5, size=layout.num_values).astype(np.float32)
    decoder = initial_decoder(decoder_width(max_levels), rng)
    for weights in decoder:
        weights += rng.normal(scale=0.1, size=weights.shape).astype(np.float32)
    return GridField(
        layout=layout,
        table=table,
        decoder=decoder,
        occupancy=occupancy,
        density_bias=density_bias,
        step_cells=1.0,
        near=0.0,
        space=box_space(),
    )


def plan_of(finest, steps, **settings) -> GridPlan:
    """A plan with these settings, by name."""
    return GridPlan(Schedule(finest=finest, steps=steps)).replaced(**settings)


def random_rays(rng, field, count):
    """Origins outside of the box and unit directions into it, float32."""
    targets = field.occupancy.lower + rng.uniform(0.1, 0.9, (count, 3)) * field.layout.extent
    origins = rng.normal(size=(count, 3))
    origins *= 4.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)
