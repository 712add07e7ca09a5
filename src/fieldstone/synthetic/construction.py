"""Walls with openings, boxes and slabs, put together from flat patches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fieldstone.synthetic import materials
from fieldstone.synthetic.materials import Albedo, Grid, Material, blend, linear, noise_like, plaster
from fieldstone.synthetic.noise import smoothstep
from fieldstone.synthetic.patches import Patch

UP = np.array([0.0, 0.0, 1.0])
DEPTH = 0.16
"""How far windows and doors lie behind the wall."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A patch and what it is made of."""

    patch: Patch
    material: Material
    leaf: int | None = None
    """Leaves: which of the shared textures."""
    coarse: float = 1.0
    """Texels this many times as large as elsewhere (far or plain surfaces)."""


@dataclass(frozen=True)
class Opening:
    """A window or door in a wall: lower left corner and size in wall coordinates, and its material."""

    a: float
    b: float
    width: float
    height: float
    material: Material
    sill: bool = True


@dataclass(eq=False)
class Builder:
    """Collects surfaces; nothing but the function that made it holds it."""

    surfaces: list[Surface] = field(default_factory=list)

    def quad(
        self, origin, edge_a, edge_b, size_a: float, size_b: float, material: Material, *, cuts=(), holes=(), **more
    ) -> None:
        """One patch; edges are normalised here."""
        unit_a, unit_b = (np.asarray(e, dtype=np.float64) / np.linalg.norm(e) for e in (edge_a, edge_b))
        patch = Patch(
            np.asarray(origin, dtype=np.float64),
            unit_a,
            unit_b,
            float(size_a),
            float(size_b),
            np.asarray(cuts, dtype=np.float64).reshape(-1, 3),
            np.asarray(holes, dtype=np.float64).reshape(-1, 4),
        )
        self.surfaces.append(Surface(patch, material, **more))

    def box(self, low, high, material: Material, top: Material | None = None, *, turn: float = 0.0) -> None:
        """Five faces of a box (none below), turned about its vertical axis by `turn` radians."""
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        middle, half, height = (low + high)[:2] / 2, (high - low)[:2] / 2, high[2] - low[2]
        x = np.array([np.cos(turn), np.sin(turn), 0.0])
        y = np.array([-np.sin(turn), np.cos(turn), 0.0])
        base = np.array([*middle, low[2]])
        for right, out, half_right, half_out in (
            (x, -y, half[0], half[1]),
            (y, x, half[1], half[0]),
            (-x, y, half[0], half[1]),
            (-y, -x, half[1], half[0]),
        ):
            self.quad(base - half_right * right + half_out * out, right, UP, 2 * half_right, height, material)
        corner = base - half[0] * x - half[1] * y + height * UP
        self.quad(corner, x, y, 2 * half[0], 2 * half[1], top or material)

    def wall(
        self,
        start,
        end,
        bottom: float,
        height: float,
        material: Material,
        openings: tuple[Opening, ...] = (),
        cuts=(),
        over: Callable[[Material], Material] = lambda material: material,
    ) -> None:
        """A wall from `start` to `end` in plan (left to right as seen from outside) with recessed openings."""
        foot = np.array([*start, bottom])
        right = np.array([end[0] - start[0], end[1] - start[1], 0.0])
        length = float(np.linalg.norm(right))
        right /= length
        inward = np.cross(UP, right)
        holes = [(o.a, o.b, o.a + o.width, o.b + o.height) for o in openings]
        self.quad(foot, right, UP, length, height, over(_framed(material, openings)), holes=holes, cuts=cuts)
        reveal = plaster("cfc6b4")
        for o in openings:
            corner = foot + o.a * right + o.b * UP
            self.quad(corner + DEPTH * inward, right, UP, o.width, o.height, o.material)
            self.quad(corner, inward, UP, DEPTH, o.height, reveal)
            self.quad(corner + DEPTH * inward + o.width * right, -inward, UP, DEPTH, o.height, reveal)
            self.quad(corner, right, inward, o.width, DEPTH, reveal)
            self.quad(corner + DEPTH * inward + o.height * UP, right, -inward, o.width, DEPTH, reveal)
            if o.sill:
                self.slab(corner - 0.1 * right - 0.09 * inward - 0.07 * UP, right, inward, o.width + 0.2, 0.09, 0.07)

    def slab(self, corner, right, inward, width: float, depth: float, height: float) -> None:
        """Front, ends and top of a stone sill or step."""
        stone = plaster("c3b69c", 0.15)
        self.quad(corner, right, UP, width, height, stone)
        self.quad(corner + depth * inward, -inward, UP, depth, height, stone)
        self.quad(corner + width * right, inward, UP, depth, height, stone)
        self.quad(corner + height * UP, right, inward, width, depth, stone)


def _framed(material: Material, openings: tuple[Opening, ...]) -> Material:
    """A wall material with stone surrounds around the openings, a darker foot and quoins at both ends."""

    def framed(a: Grid, b: Grid, rng: np.random.Generator) -> Albedo:
        out = material(a, b, rng)
        stone = materials.sandstone(a, b, rng)
        weight = np.zeros(a.shape, dtype=np.float32)
        for o in openings:
            toothed = 0.12 + 0.07 * (np.floor((b - o.b) / 0.22) % 2)
            beside = (a > o.a - toothed) & (a < o.a + o.width + toothed) & (b > o.b - 0.02) & (b < o.b + o.height)
            lintel = (a > o.a - 0.24) & (a < o.a + o.width + 0.24) & (b >= o.b + o.height) & (b < o.b + o.height + 0.24)
            weight = np.maximum(weight, (beside | lintel).astype(np.float32))
        width = float(a.max())
        toothed = 0.26 + 0.16 * (np.floor(b / 0.26) % 2)
        if width > 3.0:
            weight = np.maximum(weight, ((a < toothed) | (a > width - toothed)).astype(np.float32))
        out = blend(out, stone, weight)
        damp = smoothstep(b + 0.12 * noise_like(a, 0.8, 4, rng), 0.55, 0.1) * 0.45
        return blend(out, linear("4d4a3a"), damp.astype(np.float32)).astype(np.float32)

    return framed
