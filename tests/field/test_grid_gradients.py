"""The hand-written gradients of the fast field against autograd, group by group, and against finite differences."""

import numpy as np
import pytest

from fieldstone.field.base.volume_rendering import composite
from fieldstone.field.evidence.sparse_depth import no_sparse_depth_rays
from fieldstone.field.grid.buffers import ray_buffers, sample_buffers, work_buffers
from fieldstone.field.grid.composite_numba import composite_backward
from fieldstone.field.grid.decoder import HIDDEN, Decoder, decode
from fieldstone.field.grid.decoder_numba import decode_backward, decode_directions, decode_numba
from fieldstone.field.grid.field import FOREVER
from fieldstone.field.grid.interpolation_numba import BLOCK, add_gradient
from fieldstone.field.grid.layout import interpolate
from fieldstone.field.grid.march_numba import Samples, march_rays
from fieldstone.field.grid.render import renderer
from fieldstone.field.grid.terms_numba import SparseDepths, Terms, ray_terms
from fieldstone.scene.rays import Rays
from grid_scenes import random_field, random_rays

ROOM = 4096


def forward_and_backward(
    field, origins, directions, target, background, gain=None, points=None, **terms
) -> tuple[float, Decoder, np.ndarray, Samples, int, np.ndarray]:
    """Squared colour errors, the gradient of the loss by group, the samples of all rays, and the gradient of gains.

    points: (rows, SparseDepths), row of the point on each ray; none by default. terms: weights by name, 0 by default.
    """
    count = len(origins)
    rows, sparse_depths = points or (np.full(count, -1), no_sparse_depth_rays()[1])
    rays = ray_buffers(count)._replace(
        origins=origins.reshape(-1),
        directions=directions.reshape(-1),
        target=target.reshape(-1),
        background=background.reshape(-1),
        gain=np.ones(3 * count, np.float32) if gain is None else gain.reshape(-1),
        depth_row=rows,
        free_distance=free_before(count),
        jitter=np.full(count, 0.3, np.float32),
    )
    grid, box, march = field.layout.arrays(field.table), field.box(), field.march(0.0, 0.0)
    samples, width, used = sample_buffers(ROOM, field.width), field.width, 4 * field.layout.num_levels
    work = work_buffers(count, ROOM)
    work.d_weight[:] = 7.0
    num_rays, n, _ = march_rays(
        grid,
        box,
        march,
        rays.origins,
        rays.directions,
        rays.jitter,
        FOREVER,
        count,
        width,
        samples,
        rays.first,
        rays.end_transmittance,
    )
    assert num_rays == count
    decode_directions(field.decoder, rays.directions, count, work.per_ray)
    decode_numba(field.decoder, n, samples.features, width, used, samples.ray, work.per_ray, work.hidden, work.rgb)
    weights = Terms(**{name: np.float32(terms.get(name, 0.0)) for name in Terms._fields})
    ray_terms(samples, rays, count, sparse_depths, march.step, weights, work.d_weight)
    loss = composite_backward(samples, rays, work, count, weights, np.float32(2))
    gradient = Decoder(*(np.zeros_like(weights) for weights in field.decoder))
    transposed = np.ascontiguousarray(field.decoder.feature_weights.reshape(-1, HIDDEN).T).reshape(-1)
    decode_backward(
        field.decoder,
        transposed,
        n,
        count,
        samples.features,
        width,
        used,
        samples.ray,
        rays.directions,
        work.hidden,
        work.d_color,
        work.d_log_density,
        work.d_per_ray,
        gradient,
    )
    table = np.zeros(-(-field.layout.num_values // (8 * BLOCK)) * 8 * BLOCK, dtype=np.float32)
    touched = np.zeros(len(table) // BLOCK, dtype=np.uint8)
    for level in range(field.layout.num_levels):
        for half in (0, 1):
            add_gradient(
                grid, level, half, np.array([n]), ROOM, samples.position, samples.features, width, table, touched
            )
    return loss, gradient, table[: field.layout.num_values], samples, n, work.d_gain.reshape(count, 3)


@pytest.fixture
def case():
    rng = np.random.default_rng(3)
    field = random_field(rng)
    origins, directions = random_rays(rng, field, 60)
    target, background = rng.random((2, 60, 3)).astype(np.float32)
    return field, origins, directions, target, background


def relative_error(actual, expected):
    return np.linalg.norm(actual - expected) / np.linalg.norm(expected)


def sparse_depths_on(rng, directions) -> tuple[np.ndarray, SparseDepths]:
    """Points on every other ray, some before the box and some behind it."""
    count = len(directions)
    rows = np.where(np.arange(count) % 2 == 0, np.arange(count) // 2, -1)
    distance, sigma = rng.uniform(2.5, 5.5, count // 2), rng.uniform(0.0, 0.1, count // 2)
    return rows, SparseDepths(*np.stack([distance, sigma, np.ones(count // 2)]).astype(np.float32))


def free_before(count) -> np.ndarray:
    """Distances up to which rays probably meet nothing; some end before the box, some behind it."""
    return np.linspace(2.5, 5.5, count).astype(np.float32)


def depth_loss(points, samples, n, step, sparse_depth, free_space) -> np.ndarray:
    """What the weight of each sample counts, by the definition."""
    rows, on_rays = points
    row = rows[samples.ray[:n]]
    margin = 2.0 * on_rays.sigma[row] + step
    before = samples.distance[:n] < on_rays.distance[row] - margin
    there = (samples.distance[:n] <= on_rays.distance[row] + margin) & ~before
    early = samples.distance[:n] < free_before(len(rows))[samples.ray[:n]]
    return np.where(row < 0, free_space * early, sparse_depth * (before.astype(float) - there))


@pytest.mark.parametrize(
    ("sparsity", "sparse_depth", "emptiness", "free_space"),
    [(0.0, 0.0, 0.0, 0.0), (0.7, 0.0, 0.0, 0.0), (0.0, 0.4, 0.0, 0.0), (0.0, 0.0, 0.3, 0.0), (0.0, 0.4, 0.0, 0.2)],
)
def test_gradients_match_autograd(case, sparsity, sparse_depth, emptiness, free_space):
    torch = pytest.importorskip("torch")
    from fieldstone.field.grid_torch.field import optical_depths, packed_colors, packed_weights, torch_grid_field

    field, _, directions, target, background = case
    bare = torch.arange(60) % 3 == 0
    rng = np.random.default_rng(4)
    gain = rng.uniform(0.7, 1.4, (60, 3)).astype(np.float32)
    target[::3] = background[::3]
    points = sparse_depths_on(rng, directions)
    loss, gradient, table, samples, n, d_gain = forward_and_backward(
        *case,
        sparsity=sparsity,
        gain=gain,
        points=points,
        sparse_depth=sparse_depth,
        emptiness=emptiness,
        free_space=free_space,
    )
    twin = torch_grid_field(field, torch.float64, torch.device("cpu"))
    positions = torch.tensor(samples.position[: 3 * n].reshape(-1, 3).astype(np.float64))
    ray = torch.tensor(samples.ray[:n].astype(np.int64))
    scale = float(field.march(0.0, 0.0).depth_scale)
    colors = packed_colors(
        twin,
        positions,
        ray,
        torch.tensor(directions.astype(np.float64)),
        torch.tensor(background.astype(np.float64)),
        scale,
    )
    weights = packed_weights(twin, positions, ray, len(directions), scale)
    theta = torch.tensor(np.log(gain.astype(np.float64)), requires_grad=True)
    squared = ((theta.exp() * colors - torch.tensor(target.astype(np.float64))) ** 2).sum()
    opacity = torch.zeros(60, dtype=torch.float64).index_add(0, ray, weights)
    by_sample = depth_loss(points, samples, n, float(field.march(0.0, 0.0).step), sparse_depth, free_space)
    depths = optical_depths(twin, positions, scale)
    total = squared + sparsity * opacity.sum() + (torch.tensor(by_sample) * weights).sum()
    total = total + emptiness * torch.log1p(depths[bare[ray]]).sum()
    parameters = [*(twin.decoder[name] for name in Decoder._fields), *twin.levels, theta]
    expected = [g.numpy() for g in torch.autograd.grad(total, parameters)]
    assert loss == pytest.approx(squared.item(), rel=1e-4)
    assert relative_error(d_gain, expected[-1]) < 1e-4
    for name, of_group in zip(Decoder._fields, expected, strict=False):
        assert relative_error(getattr(gradient, name), of_group) < 1e-4, name
    for level, of_level in enumerate(expected[len(Decoder._fields) : -1]):
        actual = field.layout.level(table, level)
        for channel in range(4):
            assert relative_error(actual[..., channel], of_level[..., channel]) < 1e-4, (level, channel)


def test_gradients_match_finite_differences(case):
    field, *rest = case
    _, gradient, table, *_ = forward_and_backward(field, *rest)
    groups = {"color_bias": (field.decoder.color_bias, gradient.color_bias), "table": (field.table, table)}
    for name, (values, derivative) in groups.items():
        for index in np.argsort(-np.abs(derivative))[:3]:
            step = np.float32(5e-3)
            before = values[index]
            values[index] = before + step
            above = forward_and_backward(field, *rest)[0]
            values[index] = before - step
            below = forward_and_backward(field, *rest)[0]
            values[index] = before
            # Central differences of step h are off by h^2 / 6 of the third derivative, and by float32 rounding / h.
            assert (above - below) / (2 * float(step)) == pytest.approx(derivative[index], rel=1e-2), name


def test_decoder_matches_reference():
    rng = np.random.default_rng(0)
    field = random_field(rng)
    n, width, used = 31, field.width, 12
    features = rng.normal(size=(n, width)).astype(np.float32)
    directions = rng.normal(size=(5, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    ray = rng.integers(0, 5, n).astype(np.int32)
    per_ray, hidden, rgb = (
        np.zeros(5 * HIDDEN, np.float32),
        np.zeros(n * HIDDEN, np.float32),
        np.zeros(3 * n, np.float32),
    )
    decode_directions(field.decoder, directions.reshape(-1), 5, per_ray)
    decode_numba(field.decoder, n, features.reshape(-1), width, used, ray, per_ray, hidden, rgb)
    expected = decode(field.decoder, features[:, :used].astype(np.float64), directions[ray].astype(np.float64))
    np.testing.assert_allclose(rgb.reshape(n, 3), expected, rtol=1e-4, atol=1e-5)


def test_rendering_is_the_integral_of_density_and_color():
    """A ray's colour from the kernels equals the sum over the same positions with the readable density and colour."""
    from concurrent.futures import ThreadPoolExecutor

    from grid_scenes import FRAME

    rng = np.random.default_rng(5)
    field = random_field(rng)
    origins, directions = random_rays(rng, field, 20)
    rays = Rays(origins.astype(np.float64), directions.astype(np.float64), np.zeros(20))
    with ThreadPoolExecutor(1) as executor:
        rendered = renderer(field, FRAME, executor, min_weight=0.0, early_stop_eps=0.0)(rays)
    step = float(field.march(0.0, 0.0).step)
    for n in range(20):
        low = (field.occupancy.lower - rays.origins[n]) / rays.directions[n]
        high = (field.occupancy.lower + field.occupancy.extent - rays.origins[n]) / rays.directions[n]
        enter, leave = np.minimum(low, high).max(), np.maximum(low, high).min()
        t = np.arange(enter + 0.5 * step, leave, step)
        points = rays.origins[n] + t[:, None] * rays.directions[n]
        values = interpolate(field.layout, field.table, points - field.occupancy.lower)
        color = decode(field.decoder, values.reshape(len(t), -1), np.repeat(rays.directions[n : n + 1], len(t), axis=0))
        density = field.density(points)
        expected = composite(density[None], color[None], t[None], far=t[-1] + step, background=FRAME.background)
        np.testing.assert_allclose(rendered.rgb[n], expected.rgb[0], atol=2e-4)
        np.testing.assert_allclose(rendered.opacity[n], expected.opacity[0], atol=2e-4)
