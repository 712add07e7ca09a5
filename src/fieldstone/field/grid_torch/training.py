"""Training of the grid field on a torch device, such as a GPU.

`GridTraining` decides everything but the arithmetic of a step: rays, stages, scouting, pruning, the decoder's and the
exposures' Adam and the form of a checkpoint are its own, so that a run may change its device, and rendering stays on
the CPU. On the device are the grid, its mean squared gradients and the occupancy. They come back where the plan
changes them, for a checkpoint, and for rendering.

Departures from the step on the CPU, beside rounding:

- Rays and samples are one batch, not `GridPlan.num_chunks` chunks; its capacity is that of all chunks together.
- All levels move batch by batch; `GridPlan.immediate_levels` is about the CPU's memory.
- A GPU adds in no fixed order: the same plan gives the same field to rounding, not the same bytes.

It has been run on torch's CPU device only, never on a GPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fieldstone.field.base.radiance_field import RayRenderer, StepReport
from fieldstone.field.grid.buffers import RayBatch, ray_buffers
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.exposure import Exposure, gains_of, step_exposure
from fieldstone.field.grid.field import GridField
from fieldstone.field.grid.march_numba import March
from fieldstone.field.grid.step_numba import GRADIENT_SCALE, draw_rays
from fieldstone.field.grid.terms_numba import DEPTH_SIGMAS, DEPTH_STEPS, SparseDepths, Terms
from fieldstone.field.grid_torch.field import composite_packed, decode, depths_before, optical_depths_of
from fieldstone.field.grid_torch.layout import TorchGrid, corners_of, step_rows, torch_grid, weighted_rows
from fieldstone.field.grid_torch.march import PackedSamples, TorchBox, march_packed, torch_box
from fieldstone.field.grid_training.buffers import RAYS_PER_DEPTH_RAY
from fieldstone.field.grid_training.plan import GridPlan
from fieldstone.field.grid_training.state import GridState, claim, next_rays, stepped
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.field.grid_training.update import EPSILON, decay_factors, rates_by_channel, step_decoder


@dataclass(frozen=True, eq=False)
class TorchGridState:
    """What the next step depends on: small things on the host, the grid on the device, both updated in place."""

    host: GridState
    """Its table and mean squares are those of the last time that `grid` was brought back."""
    grid: TorchGrid
    box: TorchBox

    @property
    def plan(self) -> GridPlan:
        """As of `GridState`."""
        return self.host.plan

    @property
    def step(self) -> int:
        """As of `GridState`."""
        return self.host.step

    @property
    def exposure(self) -> Exposure:
        """As of `GridState`."""
        return self.host.exposure

    def with_plan(self, plan: GridPlan) -> TorchGridState:
        """The same state, with other steps to come."""
        return replace(self, host=self.host.with_plan(plan))

    def brought_back(self) -> GridState:
        """The state on the host, with the grid of the device."""
        self.host.field.table[:] = self.grid.vertices.reshape(-1).cpu().numpy()
        self.host.mean_square[:] = self.grid.mean_square.reshape(-1).cpu().numpy()
        return self.host


@dataclass(frozen=True, eq=False)
class TorchRays:
    """A batch of rays on the device, and what is known of them."""

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]
    """As marched: in the field's own space."""
    views: Float[Tensor, "r 3"]
    """Directions as the camera looks."""
    target: Float[Tensor, "r 3"]
    background: Float[Tensor, "r 3"]
    image: Int[Tensor, "r"]
    """Which photo shows the ray."""
    jitter: Float[Tensor, "r"]
    window: Float[Tensor, "r 2"]
    """Distances between which light must end; -inf, -inf where nothing is known."""
    free_distance: Float[Tensor, "r"]
    """Distance before which the ray probably meets nothing."""

    def first(self, count: int) -> TorchRays:
        """The first rays."""
        return TorchRays(*(getattr(self, field.name)[:count] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class StepGradient:
    """`GRADIENT_SCALE` times half the gradient of the loss of a batch, and its squared colour errors."""

    squared_error: float
    """Summed over rays and channels."""
    rows: Int[Tensor, "k"]
    """Vertices that the batch touches, each once."""
    vertices: Float[Tensor, "k c"]
    decoder: Decoder
    log_gain: Float[np.ndarray, "g"]
    """By theta of every photo and channel, flat as in `Exposure`."""


@dataclass(frozen=True, eq=False)
class TorchGridTraining:
    """Steps of a `GridTraining` on a device; a `FieldTraining`."""

    training: GridTraining
    device: torch.device

    def start(self) -> TorchGridState:
        """The state before the first step."""
        return self._on_device(self.training.start())

    def advance(self, state: TorchGridState, /) -> tuple[TorchGridState, StepReport]:
        """One step, in place: `state` is given away. Grids and occupancy change at the steps that the plan says.

        Raises:
            ValueError: The state was stepped before.
        """
        claim(state.host)
        if self.training.is_due(state.host):
            state = self._on_device(self.training.scheduled(state.brought_back()))
        host, sampling = state.host, state.plan.sampling
        multiplier = state.plan.rate_multiplier(host.step)
        march = host.field.march(sampling.min_weight, sampling.early_stop_eps)
        capacity = sampling.num_chunks * sampling.samples_per_chunk
        drawn = int(host.chunk_rays.sum())
        rays, num_depth_rays = self._drawn(host, drawn, march)
        samples = march_packed(state.grid, state.box, march, rays.origins, rays.directions, rays.jitter, capacity)
        terms = state.plan.losses.terms(multiplier, alpha_known=self.training.alpha_known)
        found = step_gradient(
            host.field, state.grid, march, terms, host.exposure, rays.first(samples.num_rays), samples
        )
        self._move(state, found, multiplier)
        used = np.array([max(samples.num_rays - num_depth_rays, 1)])
        fitting = next_rays(used, np.array([len(samples.ray)]), capacity)[0]
        chunk_rays = np.full_like(host.chunk_rays, max(fitting // sampling.num_chunks, 1))
        host = stepped(host, cursor=host.cursor + drawn, chunk_rays=chunk_rays)
        mse = found.squared_error / (3.0 * samples.num_rays)
        return replace(state, host=host), StepReport(loss=mse, mse=mse)

    def _move(self, state: TorchGridState, found: StepGradient, multiplier: float) -> None:
        """Step the grid on the device, decoder and exposures on the host, in place."""
        host, rates = state.host, state.plan.rates
        by_channel = torch.tensor(rates_by_channel(rates, multiplier), device=self.device)
        factors = torch.tensor(decay_factors(rates, multiplier, host.field.layout.num_levels), device=self.device)
        decay, epsilon = rates.mean_square_decay, float(EPSILON)
        step_rows(state.grid, found.rows, found.vertices, by_channel, factors, decay, epsilon)
        step_decoder(host, [found.decoder], multiplier)
        if rates.exposure_rate > 0:
            step_exposure(host.exposure, [found.log_gain], host.step + 1, rates.exposure_rate * multiplier)

    def to_tensors(self, state: TorchGridState, /) -> dict[str, np.ndarray]:
        """As `GridTraining.to_tensors`: another device can go on with it."""
        return self.training.to_tensors(state.brought_back())

    def from_tensors(self, tensors: Mapping[str, np.ndarray], /) -> TorchGridState:
        """The state of a checkpoint.

        Raises:
            InputError: An array is missing or has the wrong shape.
        """
        return self._on_device(self.training.from_tensors(tensors))

    def renderer(self, state: TorchGridState, /) -> RayRenderer:
        """Renders rays in normalised coordinates with the field as it is now, on the CPU."""
        return self.training.renderer(state.brought_back())

    def _on_device(self, host: GridState) -> TorchGridState:
        field = host.field
        return TorchGridState(
            host,
            torch_grid(field.layout, field.table, host.mean_square, self.device),
            torch_box(field.occupancy, field.layout.extent, field.space, self.device),
        )

    def _drawn(self, host: GridState, count: int, march: March) -> tuple[TorchRays, int]:
        """The next `count` rays of the table behind those to points, and how many these are."""
        training = self.training
        num_depth_rays = int(training.num_depth_rays(host).sum())
        rays = ray_buffers(num_depth_rays + count)
        background = training.frame.background.astype(np.float32)
        gains = gains_of(host.exposure)
        tables = (
            (host.depth_rays, host.cursor // RAYS_PER_DEPTH_RAY, num_depth_rays, training.seed + 1, 0),
            (host.rays, host.cursor, count, training.seed, num_depth_rays),
        )
        for table, start, number, seed, at in tables:
            draw_rays(table, training.space, gains, start, number, seed, background, rays, at)
        window = np.full((num_depth_rays + count, 2), -np.inf, dtype=np.float32)
        window[:num_depth_rays] = window_of(training.sparse_depths, rays.depth_row[:num_depth_rays], float(march.step))
        rays.free_distance[:num_depth_rays] = 0.0
        return torch_rays(rays, window, self.device), num_depth_rays


def window_of(sparse_depths: SparseDepths, rows: Int[np.ndarray, "k"], step: float) -> Float[np.ndarray, "k 2"]:
    """Distances between which the light of rays to points must end, see `terms_numba.ray_terms`."""
    margin = DEPTH_SIGMAS * sparse_depths.sigma[rows] + DEPTH_STEPS * np.float32(step) * sparse_depths.stretch[rows]
    return np.stack([sparse_depths.distance[rows] - margin, sparse_depths.distance[rows] + margin], axis=1)


def torch_rays(rays: RayBatch, window: Float[np.ndarray, "r 2"], device: torch.device) -> TorchRays:
    """A batch that `draw_rays` filled, copied to a device."""

    def copied(values: np.ndarray, *shape: int) -> Tensor:
        return torch.tensor(values.reshape(-1, *shape), device=device)

    return TorchRays(
        origins=copied(rays.origins, 3),
        directions=copied(rays.directions, 3),
        views=copied(rays.views, 3),
        target=copied(rays.target, 3),
        background=copied(rays.background, 3),
        image=copied(rays.image.astype(np.int64)),
        jitter=copied(rays.jitter),
        window=copied(window, 2),
        free_distance=copied(rays.free_distance),
    )


def step_gradient(
    field: GridField,
    grid: TorchGrid,
    march: March,
    terms: Terms,
    exposure: Exposure,
    rays: TorchRays,
    samples: PackedSamples,
) -> StepGradient:
    """The loss of `chunk_step` on packed samples, differentiated by autograd.

    Per ray, with the terms of `composite_backward` and `ray_terms`:

        |exp(theta) C - target|^2 + sparsity (1 - T_end) + emptiness sum log(1 + tau_i)
            + sparse_depth (...) + free_space (...).

    Args:
        field: Its decoder is used, its table is not.
    """
    device, dtype = grid.vertices.device, grid.vertices.dtype

    def leaf(array: np.ndarray) -> Tensor:
        return torch.tensor(array, device=device, dtype=dtype, requires_grad=True)

    decoder = {name: leaf(array) for name, array in field.decoder._asdict().items()}
    log_gain = leaf(exposure.log_gain.reshape(-1, 3))
    corners, weights = corners_of(grid, samples.points)
    rows, inverse = torch.unique(corners, return_inverse=True)
    vertices = grid.vertices[rows].requires_grad_()
    values = weighted_rows(vertices, inverse, weights)
    tau = optical_depths_of(values, float(march.density_bias), float(march.depth_scale))
    before, total = depths_before(tau, samples.ray, samples.num_rays)
    weight = torch.exp(-before - samples.skipped_tau) * -torch.expm1(-tau)
    end_transmittance = torch.exp(-total - samples.skipped_tau_of_ray)
    rgb = decode(decoder, values, rays.views[samples.ray])
    shown = log_gain.exp()[rays.image] * composite_packed(rgb, weight, samples.ray, end_transmittance, rays.background)
    squared = torch.sum((shown - rays.target) ** 2)
    loss = squared + other_terms(terms, rays, samples, tau, weight, end_transmittance)
    parameters = [vertices, *decoder.values(), log_gain]
    of_vertices, *rest = torch.autograd.grad(0.5 * float(GRADIENT_SCALE) * loss, parameters)
    # What follows is small, and moves on the host: one copy for all.
    flat = torch.cat([squared.detach()[None], *(part.reshape(-1) for part in rest)]).cpu().numpy()
    sizes = [1, *(part.numel() for part in rest)]
    _, *parts = np.split(flat, np.cumsum(sizes)[:-1])
    return StepGradient(float(flat[0]), rows, of_vertices, Decoder(*parts[:-1]), parts[-1])


def other_terms(
    terms: Terms,
    rays: TorchRays,
    samples: PackedSamples,
    tau: Float[Tensor, "n"],
    weight: Float[Tensor, "n"],
    end_transmittance: Float[Tensor, "r"],
) -> Float[Tensor, ""]:
    """What counts besides squared colour errors; the derivative of `ray_terms` and of `composite_backward`."""
    early, there = _around_points(rays, samples)
    probably_free = samples.distance < rays.free_distance[samples.ray]
    bare = torch.all(rays.target == rays.background, dim=1)[samples.ray]
    return (
        float(terms.sparsity) * torch.sum(1.0 - end_transmittance)
        + float(terms.sparse_depth) * torch.sum(weight * (early.to(weight.dtype) - there.to(weight.dtype)))
        + float(terms.free_space) * torch.sum(weight * probably_free)
        + float(terms.emptiness) * torch.sum(torch.log1p(tau) * bare)
    )


def _around_points(rays: TorchRays, samples: PackedSamples) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
    """Samples in front of the window of their ray, and in it."""
    low, high = rays.window[samples.ray].unbind(dim=1)
    early = samples.distance < low
    return early, ~early & (samples.distance <= high)
