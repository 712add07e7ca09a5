"""Training of the fast field on a torch device, such as a GPU.

`FastTraining` decides everything but the arithmetic of a step: rays, stages, scouting, pruning, the decoder's and the
exposures' Adam and the form of a checkpoint are its own, so that a run may change its device, and rendering stays on
the CPU. On the device are the grid, its mean squared gradients and the occupancy. They come back where the plan
changes them, for a checkpoint, and for rendering.

Departures from the step on the CPU, beside rounding:

- Rays and samples are one batch, not `FastPlan.num_chunks` chunks; its room is that of all chunks together.
- All levels move batch by batch; `FastPlan.immediate_levels` is about the CPU's memory.
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
from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.exposure import Exposure, gains_of, step_exposure
from fieldstone.field.grid.field import FastField
from fieldstone.field.grid.march_numba import March
from fieldstone.field.grid.step_numba import GRADIENT_SCALE, RayBatch, draw_rays
from fieldstone.field.grid.terms_numba import POINT_SIGMAS, POINT_STEPS, PointRays, Terms
from fieldstone.field.grid_torch.field import composite_packed, decode, depths_before, optical_depths_of
from fieldstone.field.grid_torch.layout import TorchGrid, corners_of, move_rows, torch_grid, weighted_rows
from fieldstone.field.grid_torch.march import PackedSamples, TorchBox, march_packed, torch_box
from fieldstone.field.grid_training.buffers import RAYS_PER_KNOWN, room_for_rays
from fieldstone.field.grid_training.plan import FastPlan
from fieldstone.field.grid_training.state import FastState, next_rays
from fieldstone.field.grid_training.training import FastTraining
from fieldstone.field.grid_training.update import EPSILON, kept_of, rates_of, step_decoder


@dataclass(frozen=True, eq=False)
class TorchFastState:
    """What the next step depends on: small things on the host, the grid on the device, both updated in place."""

    host: FastState
    """Its table and velocity are those of the last time that `grid` was brought back."""
    grid: TorchGrid
    box: TorchBox

    @property
    def plan(self) -> FastPlan:
        """As of `FastState`."""
        return self.host.plan

    @property
    def step(self) -> int:
        """As of `FastState`."""
        return self.host.step

    @property
    def exposure(self) -> Exposure:
        """As of `FastState`."""
        return self.host.exposure

    def with_plan(self, plan: FastPlan) -> TorchFastState:
        """The same state, with other steps to come."""
        return replace(self, host=self.host.with_plan(plan))

    def brought_back(self) -> FastState:
        """The state on the host, with the grid of the device."""
        self.host.field.table[:] = self.grid.vertices.reshape(-1).cpu().numpy()
        self.host.velocity[:] = self.grid.velocity.reshape(-1).cpu().numpy()
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
    free: Float[Tensor, "r"]
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
class TorchFastTraining:
    """Steps of a `FastTraining` on a device; a `FieldTraining`."""

    training: FastTraining
    device: torch.device

    def start(self) -> TorchFastState:
        """The state before the first step."""
        return self._on_device(self.training.start())

    def step(self, state: TorchFastState, /) -> tuple[TorchFastState, StepReport]:
        """One step; grids and occupancy change at the steps that the plan says."""
        if self.training.is_due(state.host):
            state = self._on_device(self.training.scheduled(state.brought_back()))
        host, plan = state.host, state.plan
        share = plan.rate_share(host.step)
        march = host.field.march(plan.min_weight, plan.min_light)
        room = plan.num_chunks * plan.samples_per_chunk
        drawn = int(host.chunk_rays.sum())
        rays, num_known = self._drawn(host, drawn, march)
        samples = march_packed(state.grid, state.box, march, rays.origins, rays.directions, rays.jitter, room)
        rays = rays.first(samples.num_rays)
        emptiness = 0.0 if self.training.alpha_known else plan.emptiness
        points, free = plan.point_weight * share, plan.free_weight
        terms = Terms(np.float32(plan.sparsity), np.float32(emptiness), np.float32(points), np.float32(free))
        found = step_gradient(host.field, state.grid, march, terms, host.exposure, rays, samples)
        rates = torch.tensor(rates_of(plan, share), device=self.device)
        kept = torch.tensor(kept_of(plan, share, host.field.layout.num_levels), device=self.device)
        move_rows(state.grid, found.rows, found.vertices, rates, kept, plan.decay, float(EPSILON))
        moments, rate = (host.decoder_mean, host.decoder_square), np.float32(plan.decoder_rate * share)
        step_decoder(host.field.decoder, *moments, [found.decoder], host.step + 1, rate)
        if plan.exposure_rate > 0:
            step_exposure(host.exposure, [found.log_gain], host.step + 1, plan.exposure_rate * share)
        mse = found.squared_error / (3.0 * samples.num_rays)
        used = np.array([max(samples.num_rays - num_known, 1)])
        wanted = next_rays(used, np.array([len(samples.ray)]), room)[0]
        chunk_rays = np.full_like(host.chunk_rays, max(wanted // plan.num_chunks, 1))
        host = replace(host, step=host.step + 1, cursor=host.cursor + drawn, chunk_rays=chunk_rays)
        return replace(state, host=host), StepReport(loss=mse, mse=mse)

    def to_tensors(self, state: TorchFastState, /) -> dict[str, np.ndarray]:
        """As `FastTraining.to_tensors`: another device can go on with it."""
        return self.training.to_tensors(state.brought_back())

    def from_tensors(self, tensors: Mapping[str, np.ndarray], /) -> TorchFastState:
        """The state of a checkpoint.

        Raises:
            InputError: An array is missing or has the wrong shape.
        """
        return self._on_device(self.training.from_tensors(tensors))

    def renderer(self, state: TorchFastState, /) -> RayRenderer:
        """Renders rays in normalised coordinates with the field as it is now, on the CPU."""
        return self.training.renderer(state.brought_back())

    def _on_device(self, host: FastState) -> TorchFastState:
        field = host.field
        return TorchFastState(
            host,
            torch_grid(field.layout, field.table, host.velocity, self.device),
            torch_box(field.occupancy, field.layout.extent, field.space, self.device),
        )

    def _drawn(self, host: FastState, count: int, march: March) -> tuple[TorchRays, int]:
        """The next `count` rays of the table behind those to known points, and how many these are."""
        work = self.training
        num_known = int(work.num_known(host).sum())
        rays = room_for_rays(num_known + count)
        background = work.frame.background.astype(np.float32)
        gains = gains_of(host.exposure)
        tables = ((host.known, host.cursor // RAYS_PER_KNOWN, num_known, work.seed + 1, 0),
                  (host.rays, host.cursor, count, work.seed, num_known))  # fmt: skip
        for table, start, number, seed, at in tables:
            draw_rays(table, work.space, gains, start, number, seed, background, rays, at)
        window = np.full((num_known + count, 2), -np.inf, dtype=np.float32)
        window[:num_known] = window_of(work.points, rays.point[:num_known], float(march.step))
        rays.free[:num_known] = 0.0
        return torch_rays(rays, window, self.device), num_known


def window_of(points: PointRays, rows: Int[np.ndarray, "k"], step: float) -> Float[np.ndarray, "k 2"]:
    """Distances between which the light of rays with known points must end, see `fast_terms_numba.point_terms`."""
    margin = POINT_SIGMAS * points.sigma[rows] + POINT_STEPS * np.float32(step) * points.stretch[rows]
    return np.stack([points.distance[rows] - margin, points.distance[rows] + margin], axis=1)


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
        free=copied(rays.free),
    )


def step_gradient(
    field: FastField,
    grid: TorchGrid,
    march: March,
    terms: Terms,
    exposure: Exposure,
    rays: TorchRays,
    samples: PackedSamples,
) -> StepGradient:
    """The loss of `chunk_step` on packed samples, differentiated by autograd.

    Per ray, with the terms of `composite_backward` and `point_terms`:

        |exp(theta) C - target|^2 + sparsity (1 - T_end) + emptiness sum log(1 + tau_i) + points (...) + free (...).

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
    tau = optical_depths_of(values, float(march.raw_offset), float(march.depth_scale))
    before, total = depths_before(tau, samples.ray, samples.num_rays)
    weight = torch.exp(-before - samples.veil) * -torch.expm1(-tau)
    passed = torch.exp(-total - samples.veil_behind)
    rgb = decode(decoder, values, rays.views[samples.ray])
    shown = log_gain.exp()[rays.image] * composite_packed(rgb, weight, samples.ray, passed, rays.background)
    squared = torch.sum((shown - rays.target) ** 2)
    early, there = _around_points(rays, samples)
    bare = torch.all(rays.target == rays.background, dim=1)[samples.ray]
    loss = squared + float(terms.sparsity) * torch.sum(1.0 - passed)
    loss = loss + float(terms.points) * torch.sum(weight * (early.to(dtype) - there.to(dtype)))
    probably_free = samples.distance < rays.free[samples.ray]
    loss = loss + float(terms.free) * torch.sum(weight * probably_free)
    loss = loss + float(terms.emptiness) * torch.sum(torch.log1p(tau) * bare)
    parameters = [vertices, *decoder.values(), log_gain]
    of_vertices, *rest = torch.autograd.grad(0.5 * float(GRADIENT_SCALE) * loss, parameters)
    # What follows is small, and moves on the host: one copy for all.
    flat = torch.cat([squared.detach()[None], *(part.reshape(-1) for part in rest)]).cpu().numpy()
    sizes = [1, *(part.numel() for part in rest)]
    _, *parts = np.split(flat, np.cumsum(sizes)[:-1])
    return StepGradient(float(flat[0]), rows, of_vertices, Decoder(*parts[:-1]), parts[-1])


def _around_points(rays: TorchRays, samples: PackedSamples) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
    """Samples in front of the window of their ray, and in it."""
    low, high = rays.window[samples.ray].unbind(dim=1)
    early = samples.distance < low
    return early, ~early & (samples.distance <= high)
