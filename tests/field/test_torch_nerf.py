from dataclasses import replace

import numpy as np
import pytest

from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.ray_dataset import blender_frame
from fieldstone.field.base.training import NERF, TINY
from fieldstone.field.nerf.encodings import encoded_size
from fieldstone.geometry.sim3 import Sim3

torch = pytest.importorskip("torch")

from fieldstone.field.nerf.networks import (  # noqa: E402
    density_and_color,
    initial_parameters,
    layer_sizes,
    network_size,
    render_rays,
    split_parameters,
)

SMALL_TINY = replace(TINY, width=6, position_frequencies=2, direction_frequencies=1, num_samples=4)
SMALL_NERF = replace(NERF, width=6, position_frequencies=2, direction_frequencies=1, num_samples=4, num_fine_samples=3)
FRAME = FieldFrame(Sim3(1.0, np.eye(3), np.zeros(3)), 0.5, 2.0, np.array([0.9, 0.3, 0.6]))


def double_parameters(options, seed):
    """Weights, and biases that are not zero, in float64; most densities positive."""
    rng = np.random.default_rng(seed)
    flat = initial_parameters(options, rng).astype(np.float64)
    flat = torch.from_numpy(flat + 0.1 * rng.standard_normal(flat.shape))
    parameters = split_parameters(options, flat)
    (parameters["layer5.bias"][3:] if options.network == "tiny" else parameters["density.bias"]).add_(1.5)
    return flat


def random_inputs(options, r=3, s=4, seed=0):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-1, 1, (r, s, encoded_size(options.position_frequencies)))
    directions = rng.uniform(-1, 1, (r, encoded_size(options.direction_frequencies)))
    return torch.from_numpy(positions), torch.from_numpy(directions)


def plain_network(options, p, x, d):
    """The definition for one sample, in numpy, with concatenated inputs."""

    def layer(name, v):
        return v @ p[f"{name}.weight"].numpy() + p[f"{name}.bias"].numpy()

    def relu(v):
        return np.maximum(v, 0)

    def sigmoid(v):
        return 1 / (1 + np.exp(-v))

    if options.network == "tiny":
        h = np.concatenate([x, d])
        for i in range(1, 5):
            h = layer(f"layer{i}", h)
            h = np.where(h > 0, h, np.expm1(h))
        out = layer("layer5", h)
        return relu(out[3]), sigmoid(out[:3])
    h = x
    for i in range(1, 9):
        h = relu(layer(f"layer{i}", h))
        if i == 5:
            h = np.concatenate([h, x])
    density = relu(layer("density", h))[0]
    h = relu(layer("direction", np.concatenate([layer("feature", h), d])))
    return density, sigmoid(layer("color", h))


def test_sizes_are_those_of_the_paper():
    # 63 and 27 inputs; 595,844 parameters are those of one network of the published program.
    assert network_size(NERF) == 595_844
    assert layer_sizes(TINY)["layer1"] == (39 + 39, 128)
    assert list(layer_sizes(TINY).values())[-1] == (128, 4)
    assert len(layer_sizes(TINY)) == 5


@pytest.mark.parametrize("options", [SMALL_TINY, SMALL_NERF], ids=["tiny", "nerf"])
def test_network_is_its_definition(options):
    parameters = split_parameters(options, double_parameters(options, 1))
    positions, directions = random_inputs(options)
    density, color = density_and_color(options, parameters, positions, directions)
    assert torch.count_nonzero(density) > 6
    for i in range(3):
        for j in range(4):
            expected_density, expected_color = plain_network(
                options, parameters, positions[i, j].numpy(), directions[i].numpy()
            )
            assert float(density[i, j]) == pytest.approx(expected_density, rel=1e-9)
            np.testing.assert_allclose(color[i, j].numpy(), expected_color, rtol=1e-9)


@pytest.mark.parametrize("options", [SMALL_TINY, SMALL_NERF], ids=["tiny", "nerf"])
def test_gradient_of_the_network_by_central_differences(options):
    flat = double_parameters(options, 2).requires_grad_()
    positions, directions = random_inputs(options, r=2, s=3, seed=3)

    def value(flat, positions, directions):
        return density_and_color(options, split_parameters(options, flat), positions, directions)

    inputs = (flat, positions.requires_grad_(), directions.requires_grad_())
    assert torch.autograd.gradcheck(value, inputs, eps=1e-6, atol=1e-8, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize(
    "options", [pytest.param(SMALL_TINY, id="tiny"), pytest.param(SMALL_NERF, id="nerf", marks=pytest.mark.slow)]
)
def test_gradient_of_rendered_colours_by_central_differences(options):
    """Encodings, network and volume rendering together, and both networks where there are two."""
    count = 2 if options.num_fine_samples else 1
    flat = torch.cat([double_parameters(options, 4 + k) for k in range(count)])
    rng = np.random.default_rng(5)
    origins = torch.from_numpy(rng.uniform(-0.2, 0.2, (2, 3)))
    directions = torch.nn.functional.normalize(torch.from_numpy(rng.standard_normal((2, 3))), dim=1)
    noise, fine_noise = (torch.from_numpy(rng.random((2, m))) for m in (4, options.num_fine_samples))

    def value(flat):
        networks = [split_parameters(options, part) for part in flat.chunk(count)]
        rendered = render_rays(options, FRAME, networks, origins, directions, noise, fine_noise)
        return tuple(out.rgb for out in rendered)

    assert all(torch.count_nonzero(rgb - torch.from_numpy(FRAME.background)) == 6 for rgb in value(flat))
    if count == 1:
        assert torch.autograd.gradcheck(value, flat.requires_grad_(), eps=1e-6, atol=1e-8, rtol=1e-5, fast_mode=True)
        return
    # Where fine samples lie moves with the coarse weights, and no gradient is meant to follow: the fine colours are
    # compared with respect to the fine network, the coarse ones with respect to the coarse network.
    half = len(flat) // 2
    coarse, fine = flat[:half].clone(), flat[half:].clone()
    assert torch.autograd.gradcheck(
        lambda p: value(torch.cat([p, fine]))[0], coarse.requires_grad_(), eps=1e-6, atol=1e-8, rtol=1e-5
    )
    assert torch.autograd.gradcheck(
        lambda p: value(torch.cat([coarse.detach(), p]))[1], fine.requires_grad_(), eps=1e-6, atol=1e-8, rtol=1e-5
    )


def test_fine_samples_lie_where_the_coarse_network_found_something():
    options = replace(SMALL_NERF, num_samples=16, num_fine_samples=32)
    networks = [split_parameters(options, double_parameters(options, 8 + k)) for k in range(2)]
    origins, directions = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.0, 0.6, 0.8]], dtype=torch.float64)
    noise, fine_noise = torch.full((1, 16), 0.5).double(), torch.full((1, 32), 0.5).double()
    coarse, fine = render_rays(options, FRAME, networks, origins, directions, noise, fine_noise)
    assert coarse.weights.shape == (1, 16)
    assert fine.weights.shape == (1, 48)


@pytest.mark.parametrize("options", [TINY, NERF], ids=["tiny", "nerf"])
def test_initial_parameters_are_the_same_for_a_seed_and_bounded(options):
    flat = initial_parameters(options, np.random.default_rng(3))
    np.testing.assert_array_equal(flat, initial_parameters(options, np.random.default_rng(3)))
    p = split_parameters(options, torch.from_numpy(flat))
    for name, (n_in, n_out) in layer_sizes(options).items():
        weight, bias = p[f"{name}.weight"], p[f"{name}.bias"]
        tiny = options.network == "tiny"
        # torch's own linear layer is the reference of the small network: the same bounds.
        bound = 1 / np.sqrt(n_in) if tiny else np.sqrt(6 / (n_in + n_out))
        if tiny:
            assert bound == pytest.approx(float(torch.nn.Linear(n_in, 5000).weight.detach().abs().max()), rel=1e-3)
        assert 0.9 * bound < float(weight.abs().max()) <= bound
        # Uniform on [-b, b]: variance b^2 / 3, with a standard error of b^2 sqrt(4 / 45 / n).
        error = bound**2 * np.sqrt(4 / 45 / weight.numel())
        assert abs(float(weight.var()) - bound**2 / 3) < 5 * error
        assert float(bias.abs().max()) <= (bound if tiny else 0.0)


def test_blender_frame_is_the_presets_range():
    frame = blender_frame()
    assert (frame.near, frame.far) == (2.0, 6.0)
    np.testing.assert_array_equal(frame.background, np.ones(3))
