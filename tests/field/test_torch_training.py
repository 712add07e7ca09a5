import logging
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.field.base.adam import adam_estimates
from fieldstone.field.base.budget import Budget
from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import training_rays
from fieldstone.field.base.training import NERF, PRESETS, TINY, NetworkOptions, train
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import look_at
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.rays import Rays, rays_from_view
from grid_scenes import photographs

torch = pytest.importorskip("torch")

from fieldstone.field.nerf.adam import BETA1, BETA2, EPSILON, adam  # noqa: E402
from fieldstone.field.nerf.training import TorchTraining, torch_device, torch_workers  # noqa: E402

SMALL_TINY = replace(TINY, width=16, position_frequencies=3, direction_frequencies=2, num_samples=8)
SMALL_NERF = replace(
    NERF, width=16, position_frequencies=3, direction_frequencies=1, num_samples=8, num_fine_samples=6, rays_per_step=50
)
OPTIONS = [pytest.param(SMALL_TINY, id="tiny"), pytest.param(SMALL_NERF, id="nerf")]
FRAME = FieldFrame(Sim3(1.0, np.eye(3), np.zeros(3)), 2.0, 4.5, np.ones(3))
CAMERA = Camera("SIMPLE_PINHOLE", 16, 12, np.array([18.0, 8.0, 6.0]))


def ball_photos(n=4):
    """Photos of an opaque ball at the origin, coloured by its normal, with alpha."""
    poses, pixels = [], []
    for k in range(n):
        angle = 2 * np.pi * k / n
        pose = look_at(3.2 * np.array([np.cos(angle), np.sin(angle), 0.3]), np.zeros(3), np.array([0.0, 0, 1]))
        rays = rays_from_view(CAMERA, pose)
        b = np.sum(rays.origins * rays.directions, axis=1)
        discriminant = b**2 - np.sum(rays.origins**2, axis=1) + 0.8**2
        normals = rays.origins + (-b - np.sqrt(np.maximum(discriminant, 0)))[:, None] * rays.directions
        rgba = np.concatenate([0.5 + 0.5 * normals, (discriminant > 0)[:, None]], axis=1)
        poses.append(pose)
        pixels.append(np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8).reshape(12, 16, 4))
    return photographs(CAMERA, poses, pixels)


def training(options, workers, *, photos=None, seed=3, **settings):
    rays = training_rays(photos or ball_photos(), FRAME)
    return TorchTraining(options, FRAME, rays, seed, torch.device("cpu"), workers, **settings)


def run(options, steps, threads=1, **kwargs):
    with torch_workers(threads) as workers:
        t = training(options, workers, **kwargs)
        state, curve = train(t, t.start(), budget=Budget.start(None), max_steps=steps)
        return t.to_tensors(state), curve


def assert_same_tensors(a, b):
    assert set(a) == set(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.parametrize("options", OPTIONS)
def test_resumed_training_is_bit_identical(options):
    whole, _ = run(options, 9)
    half, curve = run(options, 4)
    with torch_workers(1) as workers:
        t = training(options, workers)
        state, curve = train(t, t.from_tensors(half), budget=Budget.start(None), max_steps=9, curve=curve)
        assert_same_tensors(t.to_tensors(state), whole)
    assert [point.step for point in curve] == list(range(1, 10))
    assert np.all(np.diff([point.seconds for point in curve]) > 0)


@pytest.mark.parametrize("options", OPTIONS)
def test_any_number_of_threads_gives_the_same_bits(options):
    one, _ = run(options, 3, threads=1, samples_per_chunk=400)
    for threads in (2, 3):
        assert_same_tensors(run(options, 3, threads=threads, samples_per_chunk=400)[0], one)


@pytest.mark.parametrize("options", OPTIONS)
def test_other_seeds_give_other_fields(options):
    assert not np.array_equal(run(options, 1)[0]["parameters"], run(options, 1, seed=4)[0]["parameters"])


@pytest.mark.parametrize("loss", ["mse", "log_mse"])
@pytest.mark.parametrize("options", OPTIONS)
def test_chunks_add_up_to_the_gradient_of_the_whole_loss(options, loss):
    """Adam's first moment after one step is 0.1 times the gradient of the loss over the whole batch."""
    options = replace(options, loss=loss)
    gradients = []
    for samples_per_chunk in (150, 10**9):
        gradients.append(run(options, 1, samples_per_chunk=samples_per_chunk)[0]["first_moment"] / 0.1)
    scale = np.abs(gradients[1]).max()
    assert scale > 0
    np.testing.assert_allclose(gradients[0], gradients[1], rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize("options", OPTIONS)
def test_loss_and_mse_are_those_of_the_batch(options):
    _, mse_curve = run(replace(options, loss="mse"), 1)
    _, log_curve = run(replace(options, loss="log_mse"), 1)
    assert log_curve[0].loss == pytest.approx(np.log(mse_curve[0].loss), rel=1e-5)
    assert log_curve[0].psnr == mse_curve[0].psnr
    if options.num_fine_samples == 0:
        assert mse_curve[0].psnr == pytest.approx(-10 * np.log10(mse_curve[0].loss), rel=1e-6)


def test_adam_is_adam():
    rng = np.random.default_rng(0)
    ours = theirs = torch.from_numpy(rng.standard_normal(20))
    theirs = theirs.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=0.01, betas=(0.9, 0.999), eps=1e-7)
    first = second = torch.zeros(20, dtype=torch.float64)
    for step in range(1, 6):
        gradient = torch.from_numpy(rng.standard_normal(20))
        theirs.grad = gradient
        optimizer.step()
        ours, first, second = adam(ours, first, second, gradient, step=step, learning_rate=0.01)
    np.testing.assert_allclose(ours.numpy(), theirs.detach().numpy(), rtol=1e-9)


def test_adam_is_that_of_the_arrays_without_torch():
    rng = np.random.default_rng(1)
    values, m, v = rng.standard_normal(20).astype(np.float32), *np.zeros((2, 20), np.float32)
    ours, first, second = (torch.from_numpy(array.copy()) for array in (values, m, v))
    for step in range(1, 6):
        gradient = rng.standard_normal(20).astype(np.float32)
        numerator, denominator = adam_estimates(m, v, gradient, step, betas=(BETA1, BETA2), epsilon=EPSILON)
        values -= np.float32(0.01) * numerator / denominator
        ours, first, second = adam(ours, first, second, torch.from_numpy(gradient), step=step, learning_rate=0.01)
    np.testing.assert_allclose(ours.numpy(), values, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(second.numpy(), v, rtol=1e-4)


@pytest.mark.parametrize("options", OPTIONS)
def test_a_small_field_learns_a_ball(options):
    steps = 400
    with torch_workers(2) as workers:
        t = training(replace(options, learning_rate=5e-3, final_learning_rate=5e-3), workers)
        state, curve = train(t, t.start(), budget=Budget.start(None), max_steps=steps)
        # Far better than the best flat picture, and opaque where the ball is.
        photos = ball_photos()
        rendered = t.renderer(state)(rays_from_view(CAMERA, photos.posed.pose_of(0)))
    colors = photos.composited(0, FRAME.background).reshape(-1, 3)
    flat = np.mean((colors - colors.mean(axis=0)) ** 2)
    assert np.mean((rendered.rgb - colors) ** 2) < 0.3 * flat
    alpha = photos.pixels[0][..., 3].ravel() / 255
    assert np.corrcoef(rendered.opacity, alpha)[0, 1] > 0.8
    assert curve[-1].psnr > curve[0].psnr + 3


def test_renderer_takes_any_number_of_rays():
    with torch_workers(2) as workers:
        t = training(SMALL_NERF, workers)
        render = t.renderer(t.start())
        rays = rays_from_view(CAMERA, ball_photos().posed.pose_of(0))
        whole = render(rays)
        part = render(Rays(rays.origins[7:9], rays.directions[7:9], rays.pixel_radius[7:9]))
        np.testing.assert_allclose(part.rgb, whole.rgb[7:9], rtol=1e-4, atol=1e-6)
        none = render(Rays(rays.origins[:0], rays.directions[:0], rays.pixel_radius[:0]))
    assert none.rgb.shape == (0, 3)
    assert np.all(whole.depth <= FRAME.far * (1 + 1e-6))
    assert np.all(whole.depth >= FRAME.near)


def test_a_collapsed_field_is_noticed_and_started_again(caplog):
    """All densities zero on a black background: log(MSE) cannot move the field any more."""
    with torch_workers(1) as workers:
        t = training(SMALL_TINY, workers, max_flat_steps=5)
        tensors = t.to_tensors(t.start())
        tensors["parameters"][-1] = -100.0  # the bias of the density
        state = t.from_tensors(tensors)
        with caplog.at_level(logging.WARNING):
            for _ in range(4):
                before = state.parameters
                state, _ = t.advance(state)
                assert torch.equal(state.parameters, before)
            assert state.flat_steps == 4
            state, _ = t.advance(state)
        assert "flat colour" in caplog.text
        assert (state.attempt, state.attempt_step, state.step, state.flat_steps) == (1, 0, 5, 0)
        assert not torch.equal(state.parameters, t.start().parameters)
        state, second_report = t.advance(state)
        assert state.attempt_step == 1
        assert np.isfinite(second_report.loss)


def test_numbers_that_are_not_finite_are_a_collapse():
    with torch_workers(1) as workers:
        t = training(SMALL_TINY, workers, max_flat_steps=3)
        tensors = t.to_tensors(t.start())
        tensors["parameters"][0] = np.inf
        state, curve = train(t, t.from_tensors(tensors), budget=Budget.start(None), max_steps=4)
    assert state.attempt == 1
    assert [point.psnr for point in curve[:3]] == [0.0, 0.0, 0.0]
    assert curve[3].psnr > 0
    assert bool(torch.all(torch.isfinite(state.parameters)))


def test_flat_photos_are_no_collapse():
    pixels = np.full((12, 16, 3), 130, dtype=np.uint8)
    photos = ball_photos()
    tensors, _ = run(SMALL_TINY, 3, photos=replace(photos, pixels=(pixels,) * len(photos)))
    assert tensors["flat_steps"] == 0


def test_checkpoints_of_another_network_are_refused():
    with torch_workers(1) as workers:
        small, other = training(SMALL_TINY, workers), training(replace(SMALL_TINY, width=8), workers)
        tensors = small.to_tensors(small.start())
        with pytest.raises(InputError, match="parameters should have shape"):
            other.from_tensors(tensors)
        del tensors["second_moment"]
        with pytest.raises(InputError, match="second_moment"):
            small.from_tensors(tensors)


def test_unknown_devices_are_refused():
    with pytest.raises(InputError, match="`device` cpu"):
        torch_device("abacus")


def test_presets_are_those_of_the_course_and_the_paper():
    assert PRESETS == {"tiny": TINY, "nerf": NERF}
    assert (TINY.image_size_px, TINY.num_samples, TINY.learning_rate_at(10**6)) == (100, 32, 5e-3)
    assert (TINY.position_frequencies, TINY.rays_per_step, TINY.loss) == (6, None, "log_mse")
    assert (NERF.num_samples, NERF.num_fine_samples, NERF.width) == (64, 128, 256)
    assert (NERF.position_frequencies, NERF.direction_frequencies) == (10, 4)
    assert NERF.learning_rate_at(0) == 5e-4
    assert NERF.learning_rate_at(250_000) == pytest.approx(5e-5)
    assert NERF.learning_rate_at(125_000) == pytest.approx(np.sqrt(5e-4 * 5e-5))


@pytest.mark.parametrize(
    "change", [{"width": 0}, {"num_fine_samples": -1}, {"rays_per_step": 0}, {"final_learning_rate": 1.0}]
)
def test_impossible_options_are_refused(change):
    with pytest.raises(ValueError, match="got"):
        replace(TINY, **change)
    assert isinstance(TINY, NetworkOptions)
