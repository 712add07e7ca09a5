"""Materials that belong to one place of the house: windows, doors, ivy, the garden floor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldstone.synthetic import materials
from fieldstone.synthetic.materials import Albedo, Grid, Material, blend, linear, noise_like
from fieldstone.synthetic.noise import smoothstep


def window(columns: int, rows: int, frame: str = "efece4", curtain: str | None = None) -> Material:
    """A window with panes in a grid; behind the glass a dim room, before it a reflection of the sky."""

    def material(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        width, height = float(a.max()), float(b.max())
        u, v = a / width, b / height
        sky = smoothstep(v + 0.25 * u + 0.10 * noise_like(a, 0.7, 4, rng), 0.55, 1.15)
        glass = linear("1b2329") + sky[..., None] * (linear("7f9bb4") - linear("1b2329"))
        if curtain is not None:
            folds = 0.8 + 0.2 * np.sin(2 * np.pi * (a / 0.075 + 0.4 * noise_like(a, 0.5, 2, rng)))
            drape = 0.30 + 0.10 * np.sin(3.0 * v + rng.uniform(0, 6)) + 0.02 * noise_like(a, 0.3, 2, rng)
            cover = smoothstep(np.minimum(u, 1 - u), drape, drape - 0.03) * 0.8
            glass = blend(glass, linear(curtain) * folds[..., None], cover)
        bar = np.minimum(np.minimum(a, width - a), np.minimum(b, height - b)) < 0.065
        for k in range(1, columns):
            bar |= np.abs(a - k * width / columns) < 0.022
        for k in range(1, rows):
            bar |= np.abs(b - k * height / rows) < 0.022
        painted = materials.weathered(np.broadcast_to(linear(frame), (*a.shape, 3)), a, rng, 0.06)
        return blend(glass, painted, bar.astype(np.float32)).astype(np.float32)

    return material


def door(code: str) -> Material:
    """A panelled front door with a small light and a brass knob."""

    def material(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        width, height = float(a.max()), float(b.max())
        out = materials.planks(code, 0.5)(a, b, rng)
        for low, high in ((0.08, 0.42), (0.48, 0.68)):
            for left, right in ((0.12, 0.46), (0.54, 0.88)):
                inset = np.minimum(
                    np.minimum(a - left * width, right * width - a), np.minimum(b - low * height, high * height - b)
                )
                out = blend(out, linear("10201f"), 0.7 * smoothstep(np.abs(inset), 0.02, 0.005))
        light = (a > 0.15 * width) & (a < 0.85 * width) & (b > 0.75 * height) & (b < 0.94 * height)
        pane = window(4, 1)(a * 1.0, b, rng)
        out = np.where(light[..., None], 0.55 * pane + 0.05, out)
        knob = np.hypot(a - 0.9 * width, b - 0.46 * height) < 0.035
        return blend(out, linear("d9b24a"), knob.astype(np.float32)).astype(np.float32)

    return material


def with_ivy(material: Material, where: Callable[[Grid, Grid], Grid]) -> Material:
    """Ivy grown over a wall where `where(a, b)` (minus noise) is positive."""

    def overgrown(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        cover = smoothstep(where(a, b) + 0.16 * noise_like(a, 0.9, 6, rng, gain=0.75), 0.0, 0.06)
        return blend(material(a, b, rng), materials.leaves(a, b, rng, 0.1), cover.astype(np.float32))

    return overgrown


def ivy_at_the_corner(material: Material) -> Material:
    """Ivy at the right end of the front wall."""
    return with_ivy(material, lambda a, b: 0.9 - np.hypot((a - 8.1) / 1.0, (b - 1.0) / 3.6))


def ground(middle: float, house: tuple[float, float]) -> Material:
    """Lawn with a winding paved path to the door, a gravel yard before the annex and beds along the walls.

    Args:
        middle: Patch coordinate, along both axes, of the middle of the house.
        house: Half its width and depth, in metres.
    """

    def material(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        x, y = a - middle, b - middle
        out = materials.grass(a, b, rng)
        bend = 0.12 * noise_like(a, 1.2, 4, rng)
        path = smoothstep(np.abs(x + 0.9 - 0.9 * np.sin(0.42 * (y + 3.0))) + bend, 0.85, 0.75) * (y < -2.8)
        yard = smoothstep(np.hypot((x - 6.3) / 2.6, (y + 4.0) / 2.3) + 0.25 * bend, 1.0, 0.94)
        beds = smoothstep(np.maximum(np.abs(x) - house[0], np.abs(y) - house[1]) + bend, 0.75, 0.7)
        rows, columns = (np.flatnonzero(m.any(axis=k)) for m, k in ((yard > 0, 1), (yard > 0, 0)))
        near = np.ix_(rows, columns)
        out[near] = blend(out[near], materials.gravel(a[near], b[near], rng), yard[near])
        soil = linear("5a4630") * np.clip(1 + 0.25 * noise_like(a, 0.2, 4, rng), 0.3, 2)[..., None]
        out = blend(out, soil, beds)
        rows, columns = (np.flatnonzero(m.any(axis=k)) for m, k in ((path > 0, 1), (path > 0, 0)))
        near = np.ix_(rows, columns)
        out[near] = blend(out[near], materials.flagstones(a[near], b[near], rng), path[near])
        return out.astype(np.float32)

    return material


def meadow(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Fields far away."""
    tone = np.clip(0.5 + 0.25 * noise_like(a, 30.0, 7, rng, gain=0.75), 0, 1)[..., None]
    return (linear("4c6b2a") + tone * (linear("a5ab5c") - linear("4c6b2a"))).astype(np.float32)
