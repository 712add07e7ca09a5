"""A small brick house with an annex, a dormer, a chimney and a garden, made of flat textured patches.

World frame: metres, z up, the lawn at z = 0, the front wall at y = -3 facing -y. No two sides are alike.
"""

from __future__ import annotations

import numpy as np

from fieldstone.synthetic import materials
from fieldstone.synthetic.construction import Builder, Opening, Surface
from fieldstone.synthetic.house_materials import door, ground, ivy_at_the_corner, meadow, window
from fieldstone.synthetic.materials import Material, plaster
from fieldstone.synthetic.patches import Patch

EAVES, HALF_WIDTH, HALF_DEPTH = 5.0, 4.0, 3.0
PITCH = np.deg2rad(40.0)
NUM_LEAVES = 16
"""Number of leaf textures; the cards that share one differ in outline, size, turn and light."""
RIDGE = EAVES + HALF_DEPTH * np.tan(PITCH)
GARDEN = 17.0
"""Half the side of the detailed lawn, in metres."""


def build_house(rng: np.random.Generator) -> list[Surface]:
    """All surfaces of the house and its garden."""
    build = Builder()
    _main_block(build)
    _roof(build)
    _annex(build)
    _dormer_and_chimney(build)
    _garden(build)
    _plants(build, rng)
    return build.surfaces


def _main_block(build: Builder) -> None:
    white = window(2, 3, curtain="e8e0cf")
    tall = window(2, 4, curtain="d9b8a0")
    front = (
        Opening(0.75, 0.95, 1.15, 1.5, tall),
        Opening(2.55, 0.42, 1.1, 2.25, door("1f5c57 1c544f"), sill=False),
        Opening(4.5, 0.95, 1.15, 1.5, window(2, 3)),
        Opening(6.25, 0.95, 1.05, 1.5, window(2, 3, curtain="b7c2cf")),
        Opening(0.8, 3.15, 1.05, 1.3, white),
        Opening(2.6, 3.15, 1.05, 1.3, window(2, 3)),
        Opening(4.55, 3.15, 1.05, 1.3, window(2, 3, curtain="d8cfae")),
        Opening(6.25, 3.15, 1.05, 1.3, white),
    )
    left = (
        Opening(1.0, 1.0, 1.6, 1.35, window(3, 2, "d9d2bf", curtain="c9d0d6")),
        Opening(3.9, 1.0, 0.8, 1.35, window(1, 3)),
        Opening(2.5, 3.3, 1.0, 1.25, window(2, 3, curtain="e2d6c0")),
        Opening(2.65, 5.55, 0.7, 0.8, window(2, 2)),
    )
    right = (
        Opening(0.55, 1.0, 0.75, 1.3, window(1, 3)),
        Opening(1.0, 3.95, 0.9, 0.9, window(2, 2)),
        Opening(3.4, 3.95, 1.4, 0.9, window(3, 2, curtain="cdb9a4")),
        Opening(2.4, 5.5, 1.2, 0.6, window(4, 1)),
    )
    back = (Opening(1.2, 0.1, 1.8, 2.2, window(3, 3), sill=False), Opening(4.6, 1.0, 2.2, 1.3, window(4, 2)))
    slope = float(np.tan(PITCH))
    gable = [(-slope, 1.0, EAVES), (slope, 1.0, EAVES + slope * 2 * HALF_DEPTH)]
    w, d = HALF_WIDTH, HALF_DEPTH
    build.wall((-w, -d), (w, -d), 0.0, EAVES, materials.brick, front, over=ivy_at_the_corner)
    build.wall((w, -d), (w, d), 0.0, RIDGE, materials.brick, right, gable)
    build.wall((w, d), (-w, d), 0.0, EAVES, materials.brick, back)
    build.wall((-w, d), (-w, -d), 0.0, RIDGE, materials.brick, left, gable)


def _slope(build: Builder, origin, edge_a, edge_b, length: float, height: float, cover: Material) -> None:
    """A roof plane with its thickness: tiles, underside, board at the eaves and at both gables."""
    a, b = (np.asarray(e, dtype=np.float64) / np.linalg.norm(e) for e in (edge_a, edge_b))
    down = -0.13 * np.cross(a, b)
    board, dark = materials.planks("e4ddcc dcd3bf", 0.3, upright=False), materials.planks("6b5138 5e4630", 0.2)
    build.quad(origin, a, b, length, height, cover)
    build.quad(origin + down + b * height, a, -b, length, height, dark, coarse=2.0)
    build.quad(origin + down, a, -down, length, 0.13, board)
    build.quad(origin + down + b * height, -b, -down, height, 0.13, board)
    build.quad(origin + down + length * a, b, -down, height, 0.13, board)


def _roof(build: Builder) -> None:
    over, side = 0.45, 0.4
    rise = np.array([0.0, np.cos(PITCH), np.sin(PITCH)])
    length = (HALF_DEPTH + over) / np.cos(PITCH)
    eaves = EAVES - over * np.tan(PITCH) + 0.17
    width = 2 * (HALF_WIDTH + side)
    front = np.array([-HALF_WIDTH - side, -HALF_DEPTH - over, eaves])
    back = np.array([HALF_WIDTH + side, HALF_DEPTH + over, eaves])
    _slope(build, front, [1, 0, 0], rise, width, length, materials.tiles)
    _slope(build, back, [-1, 0, 0], rise * [1, -1, 1], width, length, materials.tiles)
    ridge = RIDGE + 0.17
    build.box((-HALF_WIDTH - side, -0.12, ridge - 0.1), (HALF_WIDTH + side, 0.12, ridge + 0.09), plaster("8d4a33", 0.3))


def _annex(build: Builder) -> None:
    x0, x1, y0, y1, high, low = 4.0, 6.8, -1.5, 2.3, 3.55, 2.45
    fall = (high - low) / (x1 - x0)
    gate = Opening(0.45, 0.05, 1.75, 2.0, materials.planks("5f7f8c 567685 6a8a96", 0.16), sill=False)
    stone = materials.fieldstone
    build.wall((x0, y0), (x1, y0), 0.0, high, stone, (gate,), cuts=[(fall, 1.0, high)])
    build.wall((x1, y0), (x1, y1), 0.0, low, stone, (Opening(1.2, 1.0, 1.5, 0.85, window(3, 1, "6a4a32")),))
    build.wall((x1, y1), (x0, y1), 0.0, high, stone, (), cuts=[(-fall, 1.0, low)])
    run = np.array([-(x1 - x0), 0.0, high - low])
    tip = np.array([x1, y0, low]) + 0.3 * np.array([1.0, -1.0, -fall]) + [0.0, 0.0, 0.1]
    length = float(np.linalg.norm(run)) * (x1 - x0 + 0.3) / (x1 - x0)
    _slope(build, tip, [0, 1, 0], run, y1 - y0 + 0.6, length, materials.tiles)


def _dormer_and_chimney(build: Builder) -> None:
    x0, x1, y, foot, eaves = 1.1, 2.7, -2.35, 5.4, 6.75
    half = (x1 - x0) / 2
    pitch = 0.85
    shingle = materials.planks("8b939a 7c848c 969ea5", 0.11, upright=False)
    glass = Opening(0.35, 0.42, 0.9, 0.85, window(2, 2, curtain="e6dccb"))
    gable = [(-pitch, 1.0, eaves - foot), (pitch, 1.0, eaves - foot + 2 * half * pitch)]
    build.wall((x0, y), (x1, y), foot, eaves - foot + half * pitch, shingle, (glass,), gable)
    build.wall((x1, y), (x1, y + 2.5), foot, eaves - foot, shingle)
    build.wall((x0, y + 2.5), (x0, y), foot, eaves - foot, shingle)
    over, reach = 0.2, 2.6
    rise = np.array([1.0, 0.0, pitch])
    length = (half + over) * float(np.linalg.norm(rise))
    left = np.array([x0 - over, y - over, eaves - over * pitch + 0.12])
    right = left + [2 * (half + over), 0.0, 0.0]
    _slope(build, left + [0.0, reach, 0.0], [0, -1, 0], rise, reach, length, materials.tiles)
    _slope(build, right, [0, 1, 0], rise * [-1, 1, 1], reach, length, materials.tiles)
    build.box((-2.7, 0.35, 6.0), (-1.85, 1.05, 8.75), materials.brick)
    build.box((-2.78, 0.27, 8.75), (-1.77, 1.13, 8.9), plaster("b8ab95", 0.2), plaster("4a4038", 0.3))
    for x in (-2.5, -2.08):
        build.box((x - 0.13, 0.57, 8.9), (x + 0.13, 0.83, 9.3), plaster("a5583a", 0.25), plaster("1c1714"))


def _garden(build: Builder) -> None:
    side, floor = 2 * GARDEN, ground(GARDEN, (HALF_WIDTH, HALF_DEPTH))
    build.quad((-GARDEN, -GARDEN, 0.0), (1, 0, 0), (0, 1, 0), side, side, floor, coarse=1.8)
    far = 140.0
    hole = (far - GARDEN + 0.01, far - GARDEN + 0.01, far + GARDEN - 0.01, far + GARDEN - 0.01)
    build.quad((-far, -far, 0.0), (1, 0, 0), (0, 1, 0), 2 * far, 2 * far, meadow, holes=[hole], coarse=25.0)
    step = plaster("b9ad97", 0.2)
    build.box((-1.7, -4.05, 0.0), (-0.1, -3.0, 0.18), step)
    build.box((-1.6, -3.6, 0.18), (-0.2, -3.0, 0.42), step)
    canopy = np.array([-1.75, -4.0, 2.78])
    _slope(build, canopy, [1, 0, 0], [0.0, 1.0, 0.42], 1.7, 1.09, materials.tiles)
    post = materials.planks("e8e2d2 ddd5c2", 0.2)
    for x in (-1.66, -0.24):
        build.box((x, -3.95, 0.18), (x + 0.1, -3.85, 2.85), post)
    wood = materials.planks("8a6a45 7a5a38 97774f", 0.12, upright=False)
    build.box((1.0, -4.0, 0.0), (2.5, -3.5, 0.45), wood, turn=0.05)
    build.box((4.35, -2.7, 0.0), (5.15, -1.95, 0.75), wood, turn=0.3)
    build.box((4.5, -2.6, 0.75), (5.0, -2.1, 1.15), wood, turn=-0.2)
    wall = materials.fieldstone
    build.box((-13.0, 8.0, 0.0), (9.0, 8.5, 1.5), wall)
    build.box((-13.0, 0.5, 0.0), (-12.5, 8.0, 1.3), wall)
    build.box((9.5, 4.0, 0.0), (12.5, 4.5, 1.2), wall, turn=-0.15)
    build.box((-7.2, -3.4, 0.0), (-5.4, -2.2, 0.55), wall, materials.leaves, turn=0.2)


def _plants(build: Builder, rng: np.random.Generator) -> None:
    """Trees and bushes: clouds of small leafy cards, each turned outward at random."""
    bark = materials.planks("5d4a38 6b5743 4d3d2e", 0.07)
    for x, y, height, radius, count in ((-8.3, 1.8, 5.6, 2.1, 260), (7.6, 5.6, 4.6, 1.8, 180)):
        build.box((x - 0.17, y - 0.17, 0.0), (x + 0.17, y + 0.17, height - 0.8), bark, turn=0.4)
        _foliage(build, np.array([x, y, height]), np.array([radius, radius, 0.85 * radius]), count, 0.8, rng)
    for x, y, radius in ((-3.4, -3.5, 0.45), (2.95, -3.45, 0.4), (7.25, 0.4, 0.5), (-4.5, -1.2, 0.5), (-4.6, 1.6, 0.6)):
        _foliage(build, np.array([x, y, 0.75 * radius]), np.full(3, radius), 34, 0.42, rng)


def _foliage(build: Builder, center, radii, count: int, size: float, rng: np.random.Generator) -> None:
    outlines = [_leaf_outline(rng) for _ in range(NUM_LEAVES)]
    for _ in range(count):
        out = rng.normal(size=3)
        out /= np.linalg.norm(out)
        place = center + radii * out * rng.uniform(0.55, 1.0)
        if place[2] < 0.05:
            continue
        normal = out + 0.5 * rng.normal(size=3)
        right = np.cross(normal, rng.normal(size=3))
        right /= np.linalg.norm(right)
        above = np.cross(normal / np.linalg.norm(normal), right)
        side, leaf = size * rng.uniform(0.7, 1.3), int(rng.integers(NUM_LEAVES))
        corner = place - 0.5 * side * (right + above)
        patch = Patch(corner, right, above, side, side, np.empty((0, 3)), np.empty((0, 4)), outlines[leaf])
        build.surfaces.append(Surface(patch, materials.leaves, leaf=leaf))


def _leaf_outline(rng: np.random.Generator) -> np.ndarray:
    """Mask of a bunch of leaves: ellipses scattered in a disc."""
    y, x = np.mgrid[:48, :48] / 24.0 - 0.979
    mask = np.zeros((48, 48), dtype=bool)
    for _ in range(26):
        radius, angle, turn = 0.78 * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi), rng.uniform(0, np.pi)
        dx, dy = x - radius * np.cos(angle), y - radius * np.sin(angle)
        along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        mask |= (along / 0.22) ** 2 + (across / 0.11) ** 2 < 1
    return mask
