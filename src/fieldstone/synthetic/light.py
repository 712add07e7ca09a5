"""Sun, sky and shadows, baked once into the textures of the patches.

Surfaces are matte, so light does not depend on the viewer: radiance = albedo (sun + sky), where the sky's share
comes from a few directions over the upper half sphere, each with its own shadow map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.synthetic.materials import linear
from fieldstone.synthetic.noise import fractal, smoothstep
from fieldstone.synthetic.patches import Patch, Texture, look

SUN = np.array([-0.52, -0.66, 0.54]) / np.linalg.norm([-0.52, -0.66, 0.54])
"""Direction to the sun, z up."""
SUN_COLOR = np.array([3.0, 2.65, 2.15], dtype=np.float32)
SKY_COLOR = np.array([0.62, 0.78, 1.05], dtype=np.float32)
GROUND_COLOR = np.array([0.20, 0.19, 0.13], dtype=np.float32)
NUM_SKY_DIRECTIONS = 14
DISTANCE = 400.0
"""The shadow maps are views from this far, in metres: nearly parallel rays."""
MAP_RADIUS = 13.0


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """How far the light of one direction reaches: a depth map seen from there."""

    direction: Float[np.ndarray, "3"]
    pose: Rigid3
    depth: Float[np.ndarray, "n n"]
    texel: float

    def reach(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p"]:
        """Share of the light that arrives at each point, blended between the four nearest texels."""
        in_light = self.pose.apply(points)
        count = len(self.depth)
        place = in_light[:, :2] / in_light[:, 2:] * (DISTANCE / self.texel) + (count / 2 - 0.5)
        place = np.minimum(np.maximum(place, 0.0), count - 1.001)
        column, row = place.astype(np.int64).T
        fx, fy = (place - np.floor(place)).T
        near = in_light[:, 2] - 2.5 * self.texel
        flat, at = self.depth.ravel(), row * count + column
        upper = (1 - fx) * (near < flat[at]) + fx * (near < flat[at + 1])
        lower = (1 - fx) * (near < flat[at + count]) + fx * (near < flat[at + count + 1])
        return ((1 - fy) * upper + fy * lower).astype(np.float32)


def shadow_map(
    patches: Sequence[Patch], direction: Float[np.ndarray, "3"], texel: float, center: Float[np.ndarray, "3"]
) -> ShadowMap:
    """The shadow map of a direction for everything within `MAP_RADIUS` of a centre."""
    pose = level_camera(center + DISTANCE * direction, center)
    count = int(2 * MAP_RADIUS / texel)
    line = (np.arange(count) + 0.5 - count / 2) * (texel / DISTANCE)
    return ShadowMap(direction, pose, look(patches, pose, *np.meshgrid(line, line)).depth, texel)


def level_camera(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float = 0.0) -> Rigid3:
    """cam_from_world of a camera at `position` that looks at `target`, its x axis level but for `roll` (radians).

    Raises:
        ValueError: The target is straight above or below.
    """
    right, down, forward = look_at(position, target, np.array([0.0, 0.0, 1.0])).R
    turned_right = np.cos(roll) * right + np.sin(roll) * down
    turned_down = np.cos(roll) * down - np.sin(roll) * right
    R = np.stack([turned_right, turned_down, forward])
    return Rigid3(R, -R @ position)


def sky_directions() -> Float[np.ndarray, "k 3"]:
    """Directions spread over the upper half sphere (golden-angle spiral, equal areas)."""
    k = np.arange(NUM_SKY_DIRECTIONS)
    z = (k + 0.7) / (NUM_SKY_DIRECTIONS + 0.7)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Shadow maps of the sun and of the sky."""

    sun: ShadowMap
    sky: tuple[ShadowMap, ...]

    @staticmethod
    def of(patches: Sequence[Patch], center: Float[np.ndarray, "3"]) -> Lighting:
        """Light around `center` that the patches block."""
        sky = tuple(shadow_map(patches, d, 0.1, center) for d in sky_directions())
        return Lighting(shadow_map(patches, SUN, 0.02, center), sky)

    def on(self, patch: Patch, texel: float) -> Float[np.ndarray, "h w 3"]:
        """Light that falls on a patch, on a grid of texels of at most the given size."""
        width, height = max(int(np.ceil(patch.size_a / texel)), 1), max(int(np.ceil(patch.size_b / texel)), 1)
        a, b = np.meshgrid(
            (np.arange(width) + 0.5) * patch.size_a / width, (np.arange(height) + 0.5) * patch.size_b / height
        )
        normal = patch.normal
        points = (patch.points(a, b) + 0.01 * normal).reshape(-1, 3)
        facing = max(float(normal @ SUN), 0.0)
        cosines = [max(float(normal @ shadow.direction), 0.0) for shadow in self.sky]
        light = self._sum(points, facing, cosines) + GROUND_COLOR * np.float32(1.0 - 0.45 * normal[2])
        return cv2.GaussianBlur(light.reshape(height, width, 3), (0, 0), 0.7).reshape(height, width, 3)

    def on_leaves(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Light on leaves: they are lit through, so it does not matter how they are turned."""
        return self._sum(points, 0.6, [0.4] * len(self.sky)) + GROUND_COLOR

    def _sum(self, points: Float[np.ndarray, "n 3"], facing: float, cosines: list[float]) -> Float[np.ndarray, "n 3"]:
        light = np.zeros((len(points), 3), dtype=np.float32)
        if facing > 0:
            light += self.sun.reach(points)[:, None] * (np.float32(facing) * SUN_COLOR)
        for shadow, cosine in zip(self.sky, cosines, strict=True):
            if cosine > 0:
                light += shadow.reach(points)[:, None] * (np.float32(2.0 * cosine / len(self.sky)) * SKY_COLOR)
        # What the sky does not fill comes from the sunlit ground: added by the callers.
        return light


@dataclass(frozen=True, eq=False)
class Sky:
    """Blue gradient with clouds, and hills at the horizon; infinitely far."""

    clouds: Texture
    hills: tuple[Float[np.ndarray, "m"], ...]

    @staticmethod
    def draw(rng: np.random.Generator) -> Sky:
        """A sky with its own clouds and hills."""
        clouds = fractal((700, 700), 0.02, 3.0, 7, rng, gain=0.55)
        hills = tuple(np.abs(fractal((1, 2048), 0.01, size, 7, rng, gain=0.5)[0]) for size in (5.0, 3.0))
        return Sky(Texture.build(clouds[..., None], 0.02), hills)

    def color(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Linear-light colour towards unit directions of the world (z up)."""
        up = np.clip(directions[:, 2], 0.0, 1.0)[:, None]
        horizon, zenith = np.float32(1.9) * linear("d3e4f2"), np.float32(1.5) * linear("4f8fd6")
        blue = horizon + smoothstep(up, -0.05, 0.5) * (zenith - horizon)
        at = directions[:, :2] / (directions[:, 2:] * 1.4 + 0.35).clip(0.05)
        cloud = self.clouds.sample(at[:, 0] + 7.0, at[:, 1] + 7.0, np.zeros(len(at)))
        out = blue + 0.9 * smoothstep(cloud, -0.2, 1.9) * (np.float32(2.3) - blue)
        azimuth = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) + 0.5
        for profile, height, code in zip(self.hills, (0.075, 0.04), ("a3bacb", "84a090"), strict=True):
            # The profile runs there and back over the circle, so that its ends meet.
            place = np.abs(2 * azimuth - 1) * (len(profile) - 1)
            top = height * (0.35 + 0.6 * np.interp(place, np.arange(len(profile)), profile))
            cover = smoothstep(directions[:, 2] - top, 0.0015, -0.0015)[:, None]
            out = out + cover * (linear(code) * (1.25 + 3.0 * up) - out)
        return out.astype(np.float32)
