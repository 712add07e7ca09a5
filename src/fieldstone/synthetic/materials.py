"""Procedural materials: linear-light albedo on a rectangle, each brick, tile, stone and leaf with its own colour.

A material is a function of the texel grid: `(a, b, rng) -> albedo (h, w, 3)` with a (right) and b (up) in metres
from the lower left corner of the patch. Nothing repeats, so that every place can be recognised.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from fieldstone.synthetic.noise import cells, fractal, smoothstep

Grid = Float[np.ndarray, "h w"]
Albedo = Float[np.ndarray, "h w 3"]
Material = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


def linear(code: str) -> Float[np.ndarray, "3"]:
    """Linear-light colour of an sRGB code such as 'a0522d'."""
    srgb = np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def palette(codes: str, u: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """Colours of a list of sRGB codes, chosen by numbers in [0, 1)."""
    colors = np.stack([linear(code) for code in codes.split()])
    return colors[np.clip((u * len(colors)).astype(np.int64), 0, len(colors) - 1)]


def blend(base: Albedo, over: np.ndarray, weight: Grid) -> Albedo:
    """`over` (an albedo or one colour) painted on `base` with a weight in [0, 1]."""
    return base + weight[..., None] * (over - base)


def texel_of(a: Grid) -> float:
    """Side of a texel of the grid, in metres."""
    return float(a[0, 1] - a[0, 0]) if a.shape[1] > 1 else 0.01


def noise_like(a: Grid, largest: float, octaves: int, rng: np.random.Generator, gain: float = 0.6) -> Grid:
    """Fractal noise on the grid."""
    return fractal((a.shape[0], a.shape[1]), texel_of(a), largest, octaves, rng, gain=gain)


def weathered(albedo: Albedo, a: Grid, rng: np.random.Generator, strength: float = 0.12) -> Albedo:
    """Stains of several sizes and grain."""
    stain = noise_like(a, 1.6, 7, rng, gain=0.72)
    return albedo * np.clip(1.0 + strength * stain, 0.3, 1.7)[..., None].astype(np.float32)


def bonded(a: Grid, b: Grid, length: float, height: float, rng: np.random.Generator) -> tuple[Grid, Grid, Albedo]:
    """Running bond: distance to the edge of the brick in metres, position across it, and its three random numbers."""
    wobble = 0.004 * noise_like(a, 0.12, 2, rng)
    row = np.floor((b + wobble) / height).astype(np.int64)
    row_shift = rng.uniform(-0.04, 0.04, size=int(row.max()) + 2)[row] + 0.5 * (row % 2)
    along = (a + wobble) / length + row_shift + 1.0
    column = np.floor(along).astype(np.int64)
    fu, fv = along - column, (b + wobble) / height - row
    edge = np.minimum(np.minimum(fu, 1 - fu) * length, np.minimum(fv, 1 - fv) * height)
    numbers = rng.random(size=(int(row.max()) + 1, int(column.max()) + 1, 3), dtype=np.float32)
    return edge.astype(np.float32), fv.astype(np.float32), numbers[np.maximum(row, 0), np.maximum(column, 0)]


def brick(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Red brick in running bond, with burnt and pale bricks, light mortar, stains and cracks."""
    edge, _, number = bonded(a, b, 0.27, 0.095, rng)
    color = palette("a4553a 94472f b4664a 8a3f2c a85f3f 7c3a2b bd7a55 99503a c08a66 6d3427", number[..., 0])
    color = color * (0.75 + 0.5 * number[..., 1:2])
    mortar = linear("b9ab98") * (0.9 + 0.1 * noise_like(a, 0.3, 3, rng)[..., None])
    out = blend(color, mortar, smoothstep(edge, 0.009, 0.004))
    crack = np.abs(noise_like(a, 2.4, 6, rng, gain=0.62))
    out = out * (1.0 - 0.45 * smoothstep(crack, 0.025, 0.0) * (noise_like(a, 3.0, 2, rng) > 0.5))[..., None]
    rain = smoothstep(noise_like(a, 1.8, 3, rng), 0.8, 2.2) * 0.35
    return weathered(blend(out, linear("5b5148"), rain), a, rng, 0.13).astype(np.float32)


def sandstone(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Dressed blocks of sandstone."""
    edge, _, number = bonded(a, b, 0.52, 0.26, rng)
    color = palette("c9b28a b89d74 d6c29c ab9370 c0a57b cbb896", number[..., 0]) * (0.8 + 0.35 * number[..., 1:2])
    out = blend(color, linear("7d705c"), smoothstep(edge, 0.012, 0.004))
    return weathered(out, a, rng, 0.17).astype(np.float32)


def fieldstone(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Rubble wall of field stones."""
    bend = 0.03 * noise_like(a, 0.4, 3, rng)
    nearest, second, number = cells(a + bend, 1.25 * (b + bend), 0.34, rng)
    color = palette("8d8679 a39a88 77726b b3a58c 93836d 6f6a66 9b917f", number[..., 0]) * (0.7 + 0.5 * number[..., 1:2])
    color = color * (1.12 - 0.5 * nearest**2)[..., None]
    out = blend(color, linear("5e564a"), smoothstep(second - nearest, 0.14, 0.05))
    lichen = smoothstep(noise_like(a, 0.5, 4, rng), 1.0, 1.8) * 0.5
    return weathered(blend(out, linear("8f9457"), lichen), a, rng, 0.18).astype(np.float32)


def tiles(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Plain clay roof tiles; b runs up the slope."""
    length, height = 0.2, 0.24
    wobble = 0.004 * noise_like(a, 0.2, 2, rng)
    row = np.floor((b + wobble) / height).astype(np.int64)
    along = a / length + 0.5 * (row % 2) + rng.uniform(-0.06, 0.06, size=int(row.max()) + 2)[row] + 1.0
    fu = along - np.floor(along)
    # The rounded lower edge of a tile lies over the row below it.
    drop = 0.25 * (2 * fu - 1) ** 2
    fv = (b + wobble) / height - row
    below = fv < drop
    row, fv = np.where(below, row - 1, row), np.where(below, fv + 1.0, fv)
    along = a / length + 0.5 * (row % 2) + 1.0
    number = rng.random(size=(int(row.max()) + 3, int(along.max()) + 2, 3), dtype=np.float32)
    number = number[row + 1, along.astype(np.int64)]
    color = palette("b4603c a24f33 c27247 8f452f b96a48 7d4234 ad5a3a 95503c", number[..., 0])
    color = color * (0.72 + 0.5 * number[..., 1:2])
    shade = 1.0 - 0.55 * smoothstep(fv - drop, 0.78, 1.05) - 0.25 * smoothstep(np.minimum(fu, 1 - fu), 0.06, 0.0)
    moss = smoothstep(noise_like(a, 1.5, 5, rng) - 0.35 * b / max(float(b.max()), 1e-9), 0.55, 1.5) * 0.75
    out = blend(color * shade[..., None], linear("6b6f3a"), moss * (0.5 + 0.5 * number[..., 2]))
    return weathered(out, a, rng, 0.13).astype(np.float32)


def planks(codes: str, width: float = 0.14, *, upright: bool = True) -> Material:
    """Painted or bare boards with grain, joints and knots."""

    def material(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        across, along = (a, b) if upright else (b, a)
        board = np.floor(across / width).astype(np.int64)
        number = rng.random(size=(int(board.max()) + 1, 2), dtype=np.float32)[board]
        color = palette(codes, number[..., 0]) * (0.8 + 0.35 * number[..., 1:2])
        fraction = across / width - board
        joint = smoothstep(np.minimum(fraction, 1 - fraction) * width, 0.007, 0.002)
        waves = np.sin(2 * np.pi * (across * 55 + 1.2 * noise_like(a, 0.5, 4, rng) + 0.6 * along))
        out = color * (1.0 + 0.10 * waves)[..., None]
        return weathered(blend(out, linear("2b211a"), 0.8 * joint), a, rng, 0.12).astype(np.float32)

    return material


def plaster(code: str, strength: float = 0.07) -> Material:
    """One colour with stains, for reveals, sills, frames and fascia boards."""

    def material(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        return weathered(np.broadcast_to(linear(code), (*a.shape, 3)), a, rng, strength).astype(np.float32)

    return material


def leaves(a: Grid, b: Grid, rng: np.random.Generator, size: float = 0.11) -> Albedo:
    """Foliage: overlapping leaves, bright at their tips, dark between."""
    bend = 0.25 * size * noise_like(a, 4 * size, 2, rng)
    nearest, _, number = cells(a + bend, b - bend, size, rng)
    color = palette("4f7a2c 5f8c34 3f6a26 77993c 35591f 8aa548 567f35", number[..., 0])
    color = color * (0.65 + 0.7 * number[..., 1:2]) * (1.25 - 1.1 * np.minimum(nearest, 1.0) ** 1.5)[..., None]
    return weathered(color, a, rng, 0.1).astype(np.float32)


def grass(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Lawn with worn places and small flowers."""
    fine = noise_like(a, 0.09, 3, rng, gain=0.9)
    tone = np.clip(0.5 + 0.16 * fine + 0.15 * noise_like(a, 2.5, 6, rng), 0, 1)[..., None]
    out = linear("3f5f1f") + tone * (linear("8fa84a") - linear("3f5f1f"))
    dry = smoothstep(noise_like(a, 4.0, 6, rng, gain=0.7), 0.7, 2.0)
    out = blend(out, linear("9c8a55") * (0.9 + 0.12 * fine)[..., None], 0.7 * dry)
    meadow = noise_like(a, 3.0, 3, rng) > 0.3
    texel, (height, width) = texel_of(a), a.shape
    count = int(2.5 * height * width * texel**2)
    row, column = rng.integers(0, max(height - 3, 1), count), rng.integers(0, max(width - 3, 1), count)
    color = palette("f2efe4 f3d34a e9e4f2 f0e9d0 d98bb0", rng.random(count))
    there = meadow[row, column]
    reach = max(round(0.045 / texel), 1)
    for dy in range(min(reach, height)):
        for dx in range(min(reach, width)):
            out[row[there] + dy, column[there] + dx] = color[there]
    return out.astype(np.float32)


def flagstones(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Irregular paving."""
    bend = 0.02 * noise_like(a, 0.3, 3, rng)
    nearest, second, number = cells(a + bend, b + bend, 0.62, rng)
    color = palette("a89c88 b8ad9b 968a78 c2b59c 8b8377 ab9f93 9f8f78", number[..., 0]) * (
        0.75 + 0.4 * number[..., 1:2]
    )
    joint = smoothstep(second - nearest, 0.10, 0.04)
    joints = linear("6d6f3e") * np.clip(1.0 + 0.25 * noise_like(a, 0.15, 3, rng), 0.4, 1.6)[..., None]
    return weathered(blend(color, joints, joint), a, rng, 0.17).astype(np.float32)


def gravel(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
    """Fine stones of many colours."""
    nearest, _, number = cells(a, b, 0.075, rng)
    color = palette("c8bca5 a89a83 dccfb6 8d8272 b7a78e e6dcc8 9a8f80", number[..., 0]) * (
        0.65 + 0.5 * number[..., 1:2]
    )
    color = color * (1.15 - 0.75 * np.minimum(nearest, 1.0) ** 2)[..., None]
    return weathered(color, a, rng, 0.12).astype(np.float32)
