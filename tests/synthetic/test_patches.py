import numpy as np
import pytest

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.synthetic.light import level_camera, shadow_map
from fieldstone.synthetic.noise import cells, fractal
from fieldstone.synthetic.patches import NEAR, Patch, Texture, look, shade


def random_patch(rng: np.random.Generator, kind: int) -> Patch:
    """A patch near the origin: plain, cut, with a hole, or with a mask, by `kind`."""
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    size_a, size_b = rng.uniform(0.5, 2.5, size=2)
    return Patch(
        rng.uniform(-1.5, 1.0, size=3),
        basis[0],
        basis[1],
        float(size_a),
        float(size_b),
        np.array([[1.0, 1.0, size_a]]) if kind == 1 else np.empty((0, 3)),
        np.array([[0.2, 0.3, 0.7 * size_a, 0.8 * size_b]]) if kind == 2 else np.empty((0, 4)),
        rng.random((7, 5)) < 0.6 if kind == 3 else None,
    )


def by_intersection(patches: list[Patch], cam_from_world: Rigid3, x: float, y: float) -> tuple[int, float]:
    """Nearest patch and depth of one ray, by solving for (depth, a, b) patch after patch."""
    center = cam_from_world.target_origin_in_source()
    direction = cam_from_world.R.T @ np.array([x, y, 1.0])
    best, nearest = -1, np.inf
    for k, p in enumerate(patches):
        depth, a, b = np.linalg.solve(np.stack([direction, -p.edge_a, -p.edge_b], axis=1), p.origin - center)
        solid = 0 <= a <= p.size_a and 0 <= b <= p.size_b
        for ca, cb, limit in p.half_planes:
            solid = solid and ca * a + cb * b <= limit
        for a0, b0, a1, b1 in p.holes:
            solid = solid and not (a0 < a < a1 and b0 < b < b1)
        if solid and p.mask is not None:
            rows, cols = p.mask.shape
            solid = bool(p.mask[int(b / p.size_b * rows), int(a / p.size_a * cols)])
        if solid and NEAR < depth < nearest:
            best, nearest = k, float(depth)
    return best, nearest


@pytest.mark.parametrize("inside", [False, True], ids=["from outside", "from among the patches"])
def test_every_ray_meets_the_patch_that_intersection_finds(inside):
    rng = np.random.default_rng(3)
    patches = [random_patch(rng, k % 4) for k in range(24)]
    pose = level_camera(np.array([0.3, 0.1, -0.2]) if inside else np.array([5.0, -3.0, 2.0]), np.zeros(3), roll=0.3)
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 31), np.linspace(-0.5, 0.5, 23))
    seen = look(patches, pose, x, y)
    expected = [by_intersection(patches, pose, u, v) for u, v in zip(x.ravel(), y.ravel(), strict=True)]
    assert len({k for k, _ in expected}) >= 8
    np.testing.assert_array_equal(seen.patch.ravel(), [k for k, _ in expected])
    np.testing.assert_allclose(seen.depth.ravel(), [d for _, d in expected], rtol=1e-9)


def test_texture_reproduces_a_ramp_at_every_level():
    texel = 0.02
    a, b = np.meshgrid((np.arange(64) + 0.5) * texel, (np.arange(32) + 0.5) * texel)
    texture = Texture.build(np.stack([a, b, a + b], axis=-1), texel)
    rng = np.random.default_rng(0)
    at_a, at_b = rng.uniform(0.1, 1.18, size=50), rng.uniform(0.1, 0.54, size=50)
    for footprint in (0.001, 0.02, 0.05, 0.09):
        sampled = texture.sample(at_a, at_b, np.full(50, footprint))
        np.testing.assert_allclose(sampled, np.stack([at_a, at_b, at_a + at_b], axis=1), rtol=1e-4, atol=1e-5)


def test_shading_puts_the_texture_where_the_patch_is():
    patch = Patch(np.array([-1.0, 2.0, -1.0]), np.eye(3)[0], np.eye(3)[2], 2.0, 2.0, np.empty((0, 3)), np.empty((0, 4)))
    a, b = np.meshgrid((np.arange(200) + 0.5) / 100, (np.arange(200) + 0.5) / 100)
    texture = Texture.build(np.stack([a, b, np.ones_like(a)], axis=-1), 0.01)
    pose = level_camera(np.array([0.4, -1.0, 0.3]), np.array([0.0, 2.0, 0.1]))
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 9), np.linspace(-0.2, 0.2, 7))
    seen = look([patch], pose, x, y)
    assert np.all(seen.patch == 0)
    tint = np.array([[1.0, 0.5, 2.0]], dtype=np.float32)
    color = shade([patch], [texture], tint, seen, pose, x, y, 0.001)
    points = pose.inverse().apply(np.stack([x, y, np.ones_like(x)], axis=-1) * seen.depth[..., None])
    expected = np.stack([points[..., 0] + 1, 0.5 * (points[..., 2] + 1), np.full(x.shape, 2.0)], axis=-1)
    np.testing.assert_allclose(color, expected, atol=1e-4)


def test_a_roof_casts_its_shadow_straight_along_the_light():
    roof = Patch(np.array([-1.0, -1.0, 2.0]), np.eye(3)[0], np.eye(3)[1], 2.0, 2.0, np.empty((0, 3)), np.empty((0, 4)))
    direction = np.array([0.6, 0.0, 0.8])
    shadow = shadow_map([roof], direction, 0.02, np.zeros(3))
    x, y = np.meshgrid(np.linspace(-4, 2, 61), np.linspace(-2, 2, 41))
    reach = shadow.reach(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)).reshape(x.shape)
    shifted = x + 2.0 * 0.6 / 0.8
    beyond = np.maximum(np.abs(shifted) - 1.0, np.abs(y) - 1.0)
    assert np.all(reach[beyond > 0.05] == 1.0)
    assert np.all(reach[beyond < -0.05] == 0.0)


def test_cells_find_the_nearest_two_centres():
    x, y = np.meshgrid(np.linspace(0, 3, 40), np.linspace(1, 3, 30))
    nearest, second, number = cells(x, y, 0.5, np.random.default_rng(5))
    # The same draws, and every centre tried for every texel.
    gx, gy = (x - x.min()) / 0.5 + 1.0, (y - y.min()) / 0.5 + 1.0
    shape = (int(gy.max()) + 3, int(gx.max()) + 3)
    center = np.random.default_rng(5).uniform(0.1, 0.9, size=(*shape, 2))
    row, column = np.mgrid[: shape[0], : shape[1]]
    distance = np.hypot(
        (column + center[..., 0]).ravel() - gx.reshape(-1, 1), (row + center[..., 1]).ravel() - gy.reshape(-1, 1)
    )
    np.testing.assert_allclose(nearest.ravel(), np.sort(distance, axis=1)[:, 0], rtol=1e-4, atol=1e-5)
    # Squares two away may hold the second nearest: never closer than the nine that are searched allow.
    assert np.mean(np.isclose(second.ravel(), np.sort(distance, axis=1)[:, 1], rtol=1e-4)) > 0.99
    same = np.argmin(distance, axis=1)
    for cell in np.unique(same):
        assert len(np.unique(number.reshape(-1, 3)[same == cell], axis=0)) == 1


def test_fractal_noise_has_unit_strength_and_the_asked_scale():
    noise = fractal((400, 500), 0.01, 0.4, 5, np.random.default_rng(0))
    assert noise.shape == (400, 500)
    assert abs(float(noise.mean())) < 0.2
    assert 0.7 < float(noise.std()) < 1.4
    step_near, step_far = (float(np.abs(noise[:, k:] - noise[:, :-k]).mean()) for k in (1, 40))
    assert step_near < 0.35 * step_far
