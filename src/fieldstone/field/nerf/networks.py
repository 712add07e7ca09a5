"""The original NeRF network and the small one of the course, as functions of a flat parameter vector.

Both take the encodings of positions and viewing directions and give density and colour:

    tiny  5 layers with ELU between them; positions and directions go in together, density and colour come out together
    nerf  8 layers of ReLU that see the position alone, the encoded position once more beside the fifth layer's output;
          density from the eighth; then a layer that also sees the direction, and the colour from that

Parameters are one flat vector, so that Adam and checkpoints need not know of layers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from fieldstone.field.base.radiance_field import FieldFrame
from fieldstone.field.base.training import NetworkOptions
from fieldstone.field.nerf.encodings import encoded_size
from fieldstone.field.nerf.rendering import Composite, composite, frequency_encoding, hierarchical, stratified

SKIP_AFTER = 5
"""The encoded position goes in again beside the output of this layer of the nerf network."""


def layer_sizes(options: NetworkOptions) -> dict[str, tuple[int, int]]:
    """(inputs, outputs) of every layer of one network, by name, in the order of the flat vector."""
    width = options.width
    position, direction = encoded_size(options.position_frequencies), encoded_size(options.direction_frequencies)
    if options.network == "tiny":
        hidden = {f"layer{i}": (width, width) for i in range(2, 5)}
        return {"layer1": (position + direction, width), **hidden, "layer5": (width, 4)}
    inputs = {1: position, SKIP_AFTER + 1: width + position}
    return {
        **{f"layer{i}": (inputs.get(i, width), width) for i in range(1, 9)},
        "density": (width, 1),
        "feature": (width, width),
        "direction": (width + direction, width // 2),
        "color": (width // 2, 3),
    }


def network_size(options: NetworkOptions) -> int:
    """Number of parameters of one network."""
    return sum((n_in + 1) * n_out for n_in, n_out in layer_sizes(options).values())


def initial_parameters(options: NetworkOptions, rng: np.random.Generator) -> Float[np.ndarray, "p"]:
    """Random weights and biases; float32.

    tiny: both uniform in +-1 / sqrt(inputs), which is what torch, and so the course, starts from. (From weights 1.7
    times as large, its learning rate of 0.005 swings from photo to photo and learns nothing in the first 80 steps.)
    nerf: weights uniform in +-sqrt(6 / (inputs + outputs)), biases zero, as the authors' program.

    Drawn with numpy, so that a seed means the same network on every device and version of torch.
    """
    parts = []
    for n_in, n_out in layer_sizes(options).values():
        if options.network == "tiny":
            bound = 1.0 / math.sqrt(n_in)
            parts += [rng.uniform(-bound, bound, n_in * n_out), rng.uniform(-bound, bound, n_out)]
        else:
            bound = math.sqrt(6.0 / (n_in + n_out))
            parts += [rng.uniform(-bound, bound, n_in * n_out), np.zeros(n_out)]
    return np.concatenate(parts).astype(np.float32)


def split_parameters(options: NetworkOptions, flat: Float[Tensor, "p"]) -> dict[str, Tensor]:
    """Views of the flat vector: for each layer `name.weight` (inputs, outputs) and `name.bias` (outputs,)."""
    out: dict[str, Tensor] = {}
    start = 0
    for name, (n_in, n_out) in layer_sizes(options).items():
        out[f"{name}.weight"] = flat[start : start + n_in * n_out].view(n_in, n_out)
        start += n_in * n_out
        out[f"{name}.bias"] = flat[start : start + n_out]
        start += n_out
    return out


def density_and_color(
    options: NetworkOptions,
    parameters: Mapping[str, Tensor],
    encoded_positions: Float[Tensor, "r s k"],
    encoded_directions: Float[Tensor, "r d"],
) -> tuple[Float[Tensor, "r s"], Float[Tensor, "r s 3"]]:
    """Density and colour of s samples on each of r rays; every sample of a ray shares its direction.

    Source:
        `mildenhall2020`, section 3 and figure 7, for `nerf`; `clevert2016` for the activation of `tiny`.
    """
    num_rays, num_samples, size = encoded_positions.shape
    positions = encoded_positions.reshape(num_rays * num_samples, size)
    network = _tiny if options.network == "tiny" else _nerf
    density, color = network(parameters, positions, encoded_directions, num_samples)
    return F.relu(density).view(num_rays, num_samples), torch.sigmoid(color).view(num_rays, num_samples, 3)


def render_rays(
    options: NetworkOptions,
    frame: FieldFrame,
    networks: Sequence[Mapping[str, Tensor]],
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    noise: Float[Tensor, "r s"],
    fine_noise: Float[Tensor, "r m"],
) -> list[Composite]:
    """What the coarse network sees along rays, and, where there is a second one, what the fine network sees.

    Args:
        noise, fine_noise: In [0, 1), where in its stratum each sample lies.

    Source:
        `mildenhall2020`, sections 4 and 5.2.
    """
    background = torch.as_tensor(frame.background, dtype=origins.dtype, device=origins.device)
    encoded_directions = frequency_encoding(directions, options.direction_frequencies)
    t = stratified(frame.near, frame.far, noise)
    out: list[Composite] = []
    for network in networks:
        if out:
            t = hierarchical(t, out[-1].weights, frame.far, fine_noise)
        positions = origins[:, None] + t[..., None] * directions[:, None]
        encoded = frequency_encoding(positions, options.position_frequencies)
        density, color = density_and_color(options, network, encoded, encoded_directions)
        out.append(composite(density, color, t, far=frame.far, background=background))
    return out


def _tiny(p: Mapping[str, Tensor], positions: Tensor, directions: Tensor, num_samples: int) -> tuple[Tensor, Tensor]:
    x = _linear_with_direction(p, "layer1", positions, directions, num_samples)
    for i in range(2, 5):
        x = _linear(p, f"layer{i}", _Elu.apply(x))
    out = _linear(p, "layer5", _Elu.apply(x))
    return out[:, 3], out[:, :3]


def _nerf(p: Mapping[str, Tensor], positions: Tensor, directions: Tensor, num_samples: int) -> tuple[Tensor, Tensor]:
    x = positions
    for i in range(1, 9):
        if i == SKIP_AFTER + 1:
            weight = p[f"layer{i}.weight"]
            width = x.shape[1]
            x = torch.addmm(p[f"layer{i}.bias"], x, weight[:width]).addmm_(positions, weight[width:])
        else:
            x = _linear(p, f"layer{i}", x)
        x = F.relu_(x)
    density = _linear(p, "density", x)
    feature = _linear(p, "feature", x)
    hidden = F.relu_(_linear_with_direction(p, "direction", feature, directions, num_samples))
    return density[:, 0], _linear(p, "color", hidden)


def _linear(p: Mapping[str, Tensor], name: str, x: Tensor) -> Tensor:
    return torch.addmm(p[f"{name}.bias"], x, p[f"{name}.weight"])


def _linear_with_direction(p: Mapping[str, Tensor], name: str, x: Tensor, directions: Tensor, s: int) -> Tensor:
    """The layer applied to (x, direction of x's ray): the direction's part is computed once per ray."""
    weight = p[f"{name}.weight"]
    of_ray = torch.addmm(p[f"{name}.bias"], directions, weight[x.shape[1] :])
    of_sample = x @ weight[: x.shape[1]]
    # Not in place: autograd would copy the gradient of a view that was written to.
    return (of_sample.view(-1, s, of_ray.shape[1]) + of_ray[:, None]).view(of_sample.shape)


class _Elu(torch.autograd.Function):
    """x for x > 0, exp(x) - 1 below; a class because that is how torch takes a gradient by hand.

    On CPUs twice as fast as torch's own, which computes expm1: exp(x) - 1 is off by 1e-7 in absolute terms, which is
    nothing beside the other terms of the next layer's sums.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        # exp(x) - 1 >= x everywhere, so the larger of x and exp(min(x, 0)) - 1 is the ELU.
        below = x.clamp(max=0).exp_().sub_(1)
        out = torch.maximum(x, below, out=below)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (out,) = ctx.saved_tensors
        return out.clamp(max=0).add_(1).mul_(gradients[0])
