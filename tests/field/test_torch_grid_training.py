"""The steps of the fast field in torch, against those of the kernels and against autograd of the dense twin."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.evaluate.image_metrics import psnr
from fieldstone.field.base.radiance_field import FieldTraining
from fieldstone.field.base.ray_dataset import SeenPoints
from fieldstone.field.base.space import box_space, contracted_space
from fieldstone.field.grid.buffers import sample_buffers
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.exposure import Exposure
from fieldstone.field.grid.field import FOREVER, field_from_tensors
from fieldstone.field.grid.march_numba import march_rays
from fieldstone.field.grid.occupancy import Occupancy
from fieldstone.field.grid.render import renderer
from fieldstone.field.grid.step_numba import GRADIENT_SCALE
from fieldstone.field.grid.terms_numba import Terms
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.scene.rays import rays_from_view
from grid_scenes import CAMERA, FRAME, RADIUS, ball_photos, ball_photos_from, plan_of, random_field, random_rays

torch = pytest.importorskip("torch")

from fieldstone.field.grid_torch.field import (  # noqa: E402
    depths_before,
    optical_depths,
    packed_colors,
    packed_weights,
    torch_grid_field,
)
from fieldstone.field.grid_torch.layout import torch_grid  # noqa: E402
from fieldstone.field.grid_torch.march import march_packed, torch_box  # noqa: E402
from fieldstone.field.grid_torch.training import TorchGridTraining, TorchRays, step_gradient  # noqa: E402

CPU = torch.device("cpu")

# The kernels' own choice for grids as small as these: all levels move batch by batch.
PLAN = plan_of(finest=32, steps=(20, 20, 20, 20, 20, 10, 5, 5), num_chunks=4, samples_per_chunk=512, immediate_levels=0)
OPEN = PLAN.replaced(
    box_warm_up=False,
    density_bias=-3.0,
    prune_density=0.01,
    min_weight=4e-3,
    exposure_rate=0.03,
    sparse_depth_weight=0.1,
)


def seen_by(photos, points):
    """What faces each camera of points on the ball."""
    facing = [points[np.einsum("ni,ni->n", points, c - points) > 0.3] for c in photos.posed.centers()]
    return [SeenPoints(p, np.full(len(p), 0.01)) for p in facing]


def photographed(scene, executor, plan=None):
    """The training of a kind of scene, and a photo that it does not have."""
    photos = ball_photos(20)
    if scene in ("alpha", "no alpha"):
        others = photos.select(range(1, 20))
        work = prepare_grid_training(others, FRAME, plan or PLAN, seed=0, executor=executor, use_alpha=scene == "alpha")
        return work, photos.select([0])
    if scene == "forward":
        places = [np.array([x, -3.2, z]) for x in (-0.4, 0.0, 0.4) for z in (-0.3, 0.0, 0.3)]
        photos = ball_photos_from(CAMERA, places)
    dark = [np.where(pixels[..., 3:] > 127, pixels[..., :3], 0) for pixels in photos.pixels]
    photos = replace(photos, pixels=tuple(np.ascontiguousarray(p) for p in dark))
    others = photos.select(range(1, len(photos)))
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    work = prepare_grid_training(
        others,
        replace(FRAME, background=np.zeros(3)),
        plan or OPEN,
        seed=0,
        executor=executor,
        points_in_world=points,
        seen=seen_by(others, points),
        bounded=False,
    )
    assert work.space.is_projective == (scene == "forward")
    return work, photos.select([0])


SCENES = ["alpha", "no alpha", "around", "forward"]


def run(work, state, steps):
    reports = []
    for _ in range(steps):
        state, report = work.advance(state)
        reports.append(report)
    return state, reports


def copied(tensors):
    return {name: array.copy() for name, array in tensors.items()}


def same_tensors(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def close(actual, expected, tolerance=1e-4):
    return np.linalg.norm(actual - expected) <= tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("done", [0, 70])
def test_a_step_is_that_of_the_kernels(scene, done):
    """From one checkpoint, both make the same step: rays, samples, gradients of all terms, and what they move."""
    with ThreadPoolExecutor(1) as executor:
        plan = (OPEN if scene in ("around", "forward") else PLAN).replaced(num_chunks=1, samples_per_chunk=2048)
        work, _ = photographed(scene, executor, plan)
        twin = TorchGridTraining(work, CPU)
        state, _ = run(work, work.start(), done)
        before = copied(work.to_tensors(state))
        state, (report,) = run(work, state, 1)
        expected = copied(work.to_tensors(state))
        twin_state, (twin_report,) = run(twin, twin.from_tensors(before), 1)
        actual = twin.to_tensors(twin_state)
    assert twin_report.loss == pytest.approx(report.loss, rel=1e-4)
    assert actual.keys() == expected.keys()
    # What is new in a moment is the gradient, or its square.
    memories = {
        "mean": 0.9,
        "square": 0.99,
        "velocity": plan.rates.mean_square_decay,
        "exposure_mean": 0.9,
        "exposure_square": 0.99,
    }
    for name in actual:
        if name == "exposure_log_gain" and done == 0:
            continue  # the first step of Adam is the sign of the gradient, and here some are nothing but rounding
        memory = next((memories[kind] for kind in memories if name.startswith(kind)), 0.0)
        of_memory = memory * before[name] if memory else 0
        np.testing.assert_equal(actual[name].dtype, expected[name].dtype)
        assert close(actual[name] - of_memory, expected[name] - of_memory), name


def test_gradients_match_autograd_of_the_dense_twin():
    """The rows that a batch touches get the gradient that they have among all vertices; float64."""
    rng = np.random.default_rng(3)
    field = random_field(rng)
    march, terms = field.march(0.0, 0.0), Terms(*(np.float32(weight) for weight in (0.7, 0.3, 0.4, 0.2)))
    origins, directions = (torch.tensor(a) for a in random_rays(rng, field, 60))
    mean_square = np.zeros_like(field.table)
    grid = torch_grid(field.layout, field.table, mean_square, CPU)
    box = torch_box(field.occupancy, field.layout.extent, box_space(), CPU)
    samples = march_packed(grid, box, march, origins, directions, torch.full((60,), 0.3), 1 << 20)
    samples = replace(samples, points=samples.points.double(), distance=samples.distance.double())
    samples = replace(
        samples, skipped_tau=samples.skipped_tau.double(), skipped_tau_of_ray=samples.skipped_tau_of_ray.double()
    )
    window = torch.tensor(np.sort(rng.uniform(2.5, 5.5, (60, 2)), axis=1))
    window[::2] = -torch.inf
    target, background = torch.tensor(rng.random((2, 60, 3)))
    target[::3] = background[::3]
    image = torch.tensor(rng.integers(0, 4, 60))
    log_gain = rng.uniform(-0.3, 0.3, 12)
    free = torch.tensor(rng.uniform(2.5, 5.5, 60))
    rays = TorchRays(
        origins.double(),
        directions.double(),
        directions.double(),
        target,
        background,
        image,
        torch.zeros(60),
        window,
        free,
    )
    double = replace(grid, vertices=grid.vertices.double(), per_unit=torch.tensor(1.0 / field.layout.spacings))
    found = step_gradient(field, double, march, terms, Exposure(log_gain, log_gain, log_gain), rays, samples)

    twin = torch_grid_field(field, torch.float64, CPU)
    scale, ray = float(march.depth_scale), samples.ray
    theta = torch.tensor(log_gain.reshape(4, 3), requires_grad=True)
    colors = packed_colors(twin, samples.points, ray, rays.views, background, scale)
    weights = packed_weights(twin, samples.points, ray, 60, scale)
    squared = ((theta.exp()[image] * colors - target) ** 2).sum()
    before = samples.distance < window[ray, 0]
    there = (samples.distance <= window[ray, 1]) & ~before
    bare = (torch.arange(60) % 3 == 0)[ray]
    depths = optical_depths(twin, samples.points, scale)
    loss = squared + float(terms.sparsity) * weights.sum() + float(terms.emptiness) * torch.log1p(depths[bare]).sum()
    loss = loss + float(terms.sparse_depth) * (weights[before].sum() - weights[there].sum())
    loss = loss + float(terms.free_space) * weights[samples.distance < free[ray]].sum()
    parameters = [*twin.levels, *(twin.decoder[name] for name in Decoder._fields), theta]
    expected = [0.5 * float(GRADIENT_SCALE) * g.numpy() for g in torch.autograd.grad(loss, parameters)]
    assert found.squared_error == pytest.approx(squared.item(), rel=1e-9)
    table = np.zeros((len(field.table) // 4, 4))
    table[found.rows.numpy()] = found.vertices.numpy()
    for level in range(field.layout.num_levels):
        assert close(field.layout.level(table.reshape(-1), level), expected[level], 1e-9)
    for actual, of_group in zip([*found.decoder, found.log_gain], expected[field.layout.num_levels :], strict=True):
        assert close(actual.reshape(-1), of_group.reshape(-1), 1e-9)


@pytest.mark.parametrize("space", [box_space(), contracted_space(0.5)], ids=["box", "contracted"])
@pytest.mark.parametrize("min_weight", [0.0, 2e-2])
def test_samples_are_those_of_the_kernels(space, min_weight):
    """Same places, and the same light at each, of which some was taken by samples that are left out."""
    rng = np.random.default_rng(1)
    field = replace(random_field(rng, density_bias=-1.5), space=space, near=0.1)
    cells = rng.random(field.occupancy.cells.shape) < 0.4
    field = replace(field, occupancy=Occupancy(field.occupancy.lower, field.occupancy.cell_size, cells))
    origins, directions = random_rays(rng, field, 200)
    origins[0], directions[0] = field.occupancy.lower + [0.6, 0.6, -3.0], [0, 0, 1]  # along two faces
    origins[1], directions[1] = field.occupancy.lower + [-0.1, 0.6, -3.0], [0, 0, 1]  # beside the box
    jitter = rng.random(200).astype(np.float32)
    march = field.march(min_weight, 1e-2)
    kernel, first, end_transmittance = (
        sample_buffers(1 << 15, field.width),
        np.zeros(201, np.int64),
        np.zeros(200, np.float32),
    )
    num_rays, n, _ = march_rays(
        field.layout.arrays(field.table),
        field.box(),
        march,
        origins.reshape(-1),
        directions.reshape(-1),
        jitter,
        FOREVER,
        200,
        field.width,
        kernel,
        first,
        end_transmittance,
    )
    assert num_rays == 200
    grid = torch_grid(field.layout, field.table, np.zeros_like(field.table), CPU)
    box = torch_box(field.occupancy, field.layout.extent, space, CPU)
    rays = (torch.tensor(origins), torch.tensor(directions), torch.tensor(jitter))
    found = march_packed(grid, box, march, *rays, 1 << 15)
    np.testing.assert_array_equal(found.ray.numpy(), kernel.ray[:n])
    np.testing.assert_allclose(found.points.numpy(), kernel.position[: 3 * n].reshape(n, 3), atol=1e-5)
    np.testing.assert_allclose(found.distance.numpy(), kernel.distance[:n], rtol=1e-4)
    before, total = depths_before(torch.tensor(kernel.tau[:n]), found.ray, 200)
    np.testing.assert_allclose(torch.exp(-before - found.skipped_tau).numpy(), kernel.transmittance[:n], rtol=1e-4)
    np.testing.assert_allclose(
        torch.exp(-total - found.skipped_tau_of_ray).numpy(), end_transmittance, rtol=1e-4, atol=1e-5
    )
    assert bool((found.skipped_tau_of_ray > 0).any()) == (min_weight > 0)
    # Where there is no room for all, whole rays are left out, from the last on.
    part = march_packed(grid, box, march, *rays, n // 2)
    assert first[part.num_rays] < n // 2 <= first[part.num_rays + 1]
    np.testing.assert_array_equal(part.points.numpy(), found.points[: first[part.num_rays]].numpy())


def test_depths_run_along_each_ray_on_its_own():
    tau = torch.tensor([3e4, 1e-3, 2e-3, 5.0])
    before, total = depths_before(tau, torch.tensor([0, 2, 2, 2]), 4)
    np.testing.assert_allclose(before.numpy(), [0.0, 0.0, 1e-3, 3e-3], rtol=1e-6)
    np.testing.assert_allclose(total.numpy(), [3e4, 0.0, 5.003, 0.0], rtol=1e-6)
    before, total = depths_before(tau[:0], torch.zeros(0, dtype=torch.int64), 2)
    assert len(before) == 0
    assert total.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    "scene", ["alpha", "around", *(pytest.param(scene, marks=pytest.mark.slow) for scene in ("no alpha", "forward"))]
)
def test_it_learns_as_well_as_the_kernels(scene):
    """The same plan, through all stages: the loss falls as far, and a photo that was left out is met as well."""
    with ThreadPoolExecutor(1) as executor:
        work, photo = photographed(scene, executor)
        expected, actual = (learned(one, photo) for one in (work, TorchGridTraining(work, CPU)))
    # What two seeds of one learner differ by.
    assert actual > expected - 1.0


def learned(work: FieldTraining, photo):
    """PSNR of a photo after the whole plan, in dB."""
    assert isinstance(work, FieldTraining)
    state, reports = run(work, work.start(), PLAN.schedule.total_steps)
    rendered = work.renderer(state)(rays_from_view(CAMERA, photo.posed.pose_of(0)))
    losses = [report.loss for report in reports]
    assert np.mean(losses[-5:]) < 0.1 * np.mean(losses[:5])
    shown = rendered.rgb.reshape(CAMERA.height, CAMERA.width, 3)
    return psnr(shown, photo.composited(0, FRAME.background if photo.have_alpha else np.zeros(3)))


@pytest.mark.parametrize("scene", SCENES)
def test_rays_that_meet_nothing_move_nothing(scene):
    """What they show is the background, and a step from it is finite."""
    with ThreadPoolExecutor(1) as executor:
        work, _ = photographed(scene, executor)
        empty = replace(work.occupancy, cells=np.zeros_like(work.occupancy.cells))
        twin = TorchGridTraining(replace(work, occupancy=empty), CPU)
        state = twin.start()
        before = copied(state.host.field.decoder._asdict())
        state, (report,) = run(twin, state, 1)
    assert np.isfinite(report.loss)
    assert not state.grid.mean_square.any()
    same_tensors(before, state.host.field.decoder._asdict())


def test_the_field_survives_saving_and_is_rendered_without_torch():
    with ThreadPoolExecutor(1) as executor:
        work, photo = photographed("around", executor)
        twin = TorchGridTraining(work, CPU)
        state, _ = run(twin, twin.start(), 30)
        saved = copied(twin.to_tensors(state))
        same_tensors(twin.to_tensors(twin.from_tensors(saved)), saved)
        rays = rays_from_view(CAMERA, photo.posed.pose_of(0))
        shown = twin.renderer(state)(rays)
        again = renderer(field_from_tensors(saved), work.frame, executor)(rays)
    np.testing.assert_array_equal(shown.rgb, again.rgb)
    np.testing.assert_array_equal(shown.depth, again.depth)


@pytest.mark.parametrize("stop", [1, 12])
def test_a_stop_changes_nothing(stop):
    """On the CPU, where torch adds in a fixed order, not a bit."""
    with ThreadPoolExecutor(1) as executor:
        plan = PLAN.replaced(steps=(5, 5, 3, 3, 1, 1, 1, 1))
        work = TorchGridTraining(photographed("no alpha", executor, plan)[0], CPU)
        through, _ = run(work, work.start(), plan.schedule.total_steps)
        stopped, _ = run(work, work.start(), stop)
        saved = copied(work.to_tensors(stopped))
        resumed, _ = run(work, work.from_tensors(saved), plan.schedule.total_steps - stop)
        same_tensors(work.to_tensors(through), work.to_tensors(resumed))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_learns_as_torch_does_on_the_cpu():
    with ThreadPoolExecutor(1) as executor:
        work, _ = photographed("alpha", executor)
        mse = []
        for device in (CPU, torch.device("cuda")):
            learner = TorchGridTraining(work, device)
            _, reports = run(learner, learner.start(), PLAN.schedule.total_steps)
            mse.append(np.mean([report.mse for report in reports[-10:]]))
    assert abs(10 * np.log10(mse[1] / mse[0])) < 1.0
