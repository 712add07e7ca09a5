import numpy as np
import pytest

from fieldstone.field.base import volume_rendering
from fieldstone.field.nerf import encodings, sampling

torch = pytest.importorskip("torch")

from fieldstone.field.nerf import rendering as torch_rendering  # noqa: E402


def random_samples(seed=0, r=5, s=9):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(2, 6, (r, s)), axis=1)
    return rng.exponential(size=(r, s)), rng.random((r, s, 3)), t, rng.random(3)


def test_encoding_matches_the_reference():
    x = np.random.default_rng(0).uniform(-2, 2, (4, 5, 3))
    actual = torch_rendering.frequency_encoding(torch.from_numpy(x), 6)
    np.testing.assert_allclose(actual.numpy(), encodings.frequency_encoding(x, 6), rtol=1e-9, atol=1e-12)


def test_encoding_in_float32_is_within_the_rounding_of_its_argument():
    x = np.random.default_rng(0).uniform(-2, 2, (50, 3))
    actual = torch_rendering.frequency_encoding(torch.from_numpy(x).float(), 10)
    # x in float32 is off by 2^-24 |x|, and frequency 2^9 multiplies that.
    np.testing.assert_allclose(actual.numpy(), encodings.frequency_encoding(x, 10), atol=2 * 2**9 * 2.0**-23)


def test_sampling_matches_the_reference():
    rng = np.random.default_rng(1)
    noise = rng.random((6, 8))
    t = sampling.stratified(2.0, 6.0, noise)
    np.testing.assert_allclose(torch_rendering.stratified(2.0, 6.0, torch.from_numpy(noise)).numpy(), t, rtol=1e-12)
    weights = rng.exponential(size=(6, 8)) * (rng.random((6, 8)) < 0.6)
    weights[0] = 0.0
    fine_noise = rng.random((6, 20))
    on_torch = [torch.from_numpy(a) for a in (t, weights, fine_noise)]
    actual = torch_rendering.hierarchical(on_torch[0], on_torch[1], 6.0, on_torch[2])
    np.testing.assert_allclose(actual.numpy(), sampling.hierarchical(t, weights, 6.0, fine_noise), rtol=1e-9)


def test_composite_matches_the_reference():
    density, color, t, background = random_samples()
    expected = volume_rendering.composite(density, color, t, far=6.0, background=background)
    on_torch = [torch.from_numpy(a) for a in (density, color, t, background)]
    actual = torch_rendering.composite(on_torch[0], on_torch[1], on_torch[2], far=6.0, background=on_torch[3])
    for name in ("rgb", "depth", "opacity", "weights"):
        np.testing.assert_allclose(getattr(actual, name).numpy(), getattr(expected, name), rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("output", ["rgb", "depth", "opacity", "weights"])
def test_gradient_of_composite_by_central_differences(output):
    density, color, t, background = (torch.from_numpy(a) for a in random_samples(2, r=2, s=5))
    density[0, 1] = 0.0

    def value(density, color, background):
        return getattr(torch_rendering.composite(density, color, t, far=6.0, background=background), output)

    inputs = [x.clone().requires_grad_() for x in (density, color, background)]
    assert torch.autograd.gradcheck(value, inputs, eps=1e-6, atol=1e-8, rtol=1e-6)


def test_gradient_of_the_encoding_by_central_differences():
    x = torch.from_numpy(np.random.default_rng(3).uniform(-1, 1, (4, 3))).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: torch_rendering.frequency_encoding(x, 4), x, eps=1e-6, rtol=1e-6)


def test_gradients_stay_finite_at_the_edges():
    # No density, an opaque sample in front, and two samples at one place.
    density = torch.tensor([[0.0, 0.0, 0.0], [1e8, 1.0, 0.0], [1.0, 1.0, 1.0]], requires_grad=True)
    t = torch.tensor([[2.0, 3.0, 4.0], [2.0, 3.0, 4.0], [2.0, 2.0, 6.0]])
    out = torch_rendering.composite(density, torch.rand(3, 3, 3), t, far=6.0, background=torch.ones(3))
    (gradient,) = torch.autograd.grad(out.rgb.sum() + out.depth.sum(), density)
    assert torch.all(torch.isfinite(gradient))
    assert torch.all(torch.isfinite(out.rgb))


def test_no_gradient_flows_through_sample_positions():
    weights = torch.rand(2, 4, requires_grad=True)
    t = torch_rendering.hierarchical(torch.sort(torch.rand(2, 4), dim=1).values, weights, 2.0, torch.rand(2, 3))
    assert not t.requires_grad
