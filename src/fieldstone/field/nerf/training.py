"""Training and rendering of the networks: one step is a pure function of (state, step number).

Batches are cut into chunks of rays whose activations fit the cache. Chunks go to threads that run torch with one
thread each; the loss is a function of the sum of squared errors, so its gradient is put together from the chunks
exactly, and always in their order. The result of a step therefore is the same bits for any number of threads (on the
same machine, torch and device; other processors and versions of their libraries may round differently).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, RenderedRays, StepReport
from fieldstone.field.base.ray_dataset import TrainingRays
from fieldstone.field.base.training import NetworkOptions
from fieldstone.field.nerf.adam import adam
from fieldstone.field.nerf.networks import initial_parameters, network_size, render_rays, split_parameters
from fieldstone.scene.rays import Rays

logger = logging.getLogger(__name__)

SAMPLES_PER_CHUNK = 4096
"""Network evaluations of one chunk on a CPU: 2 MB per layer of 128 units, measured the fastest."""

MIN_CONTRAST = 0.01
MAX_FLAT_STEPS = 30
MAX_ATTEMPTS = 4
"""A field whose images are flat (spread below 1 % of that of the photos) for this many steps has collapsed: every
density is zero or every colour saturated, gradients vanish, and it never recovers. It is started again, at most
this often, from other random weights."""

STREAM_WEIGHTS, STREAM_ORDER, STREAM_STEP = 0, 1, 2
"""What the streams of random numbers are for; see `TorchTraining.advance`."""


@dataclass(frozen=True, eq=False)
class TorchState:
    """Parameters (the coarse network, then the fine one), Adam's moments, and where in the training they are."""

    parameters: Float[Tensor, "p"]
    first_moment: Float[Tensor, "p"]
    second_moment: Float[Tensor, "p"]
    step: int
    attempt: int
    """How often the field collapsed and was started again."""
    attempt_step: int
    """Steps done in this attempt."""
    flat_steps: int
    """Consecutive steps with a flat image, up to now."""


@contextmanager
def torch_workers(threads: int) -> Iterator[Executor]:
    """Threads for the chunks of a batch; torch works with one thread inside of each."""
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as workers:
        yield workers


def torch_device(name: str) -> torch.device:
    """The device of a name such as `cpu`, `cuda` or `mps`.

    Raises:
        InputError: Unknown, or not there.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"device {name!r} cannot be used ({reason}); use `device` cpu") from error
    return device


@dataclass(frozen=True, eq=False)
class TorchTraining:
    """`FieldTraining` of the networks. `rays` may be None where a field is only rendered."""

    options: NetworkOptions
    frame: FieldFrame
    rays: TrainingRays | None
    seed: int
    device: torch.device
    workers: Executor
    samples_per_chunk: int = SAMPLES_PER_CHUNK
    """Network evaluations of one chunk on a CPU."""
    max_flat_steps: int = MAX_FLAT_STEPS
    """Steps with flat images after which training begins again."""

    @property
    def num_networks(self) -> int:
        """1, or 2 with a fine network."""
        return 2 if self.options.num_fine_samples else 1

    @property
    def rays_per_chunk(self) -> int:
        """Rays that are evaluated together: few on a CPU, to stay in its cache."""
        evaluations = self.options.num_samples + self.options.num_fine_samples
        return max(1, (self.samples_per_chunk if self.device.type == "cpu" else 1 << 20) // evaluations)

    def start(self) -> TorchState:
        """Random weights, moments zero."""
        return self._attempt(0, 0)

    def advance(self, state: TorchState, /) -> tuple[TorchState, StepReport]:
        """One step of Adam on one batch; a collapsed field is started again.

        Random numbers: the order of the photos follows from (seed, epoch), the batch and the jitter of the samples
        from (seed, step), the weights from (seed, attempt).
        """
        assert self.rays is not None
        rng = np.random.default_rng([self.seed, STREAM_STEP, state.step])
        rays, colors = self._batch(state.step, rng)
        options = self.options
        arrays = [
            rays.origins,
            rays.directions,
            colors,
            rng.random((len(rays), options.num_samples), dtype=np.float32),
            rng.random((len(rays), options.num_fine_samples), dtype=np.float32),
        ]
        chunks = list(zip(*(self._tensor(a).split(self.rays_per_chunk) for a in arrays), strict=True))
        losses = list(self.workers.map(lambda chunk: self._chunk_loss(state.parameters, *chunk), chunks))
        total = losses[0]
        for loss in losses[1:]:
            total = total + loss
        return self._updated(state, total, colors)

    def to_tensors(self, state: TorchState, /) -> dict[str, np.ndarray]:
        """The whole state; nothing else is needed to go on."""
        return {
            "parameters": state.parameters.cpu().numpy(),
            "first_moment": state.first_moment.cpu().numpy(),
            "second_moment": state.second_moment.cpu().numpy(),
            "step": np.array(state.step),
            "attempt": np.array(state.attempt),
            "attempt_step": np.array(state.attempt_step),
            "flat_steps": np.array(state.flat_steps),
        }

    def from_tensors(self, tensors: Mapping[str, np.ndarray], /) -> TorchState:
        """The state of a checkpoint.

        Raises:
            InputError: An array is missing or has the wrong shape.
        """
        size = self.num_networks * network_size(self.options)
        counters = dict.fromkeys(("step", "attempt", "attempt_step", "flat_steps"), ())
        shapes = dict.fromkeys(("parameters", "first_moment", "second_moment"), (size,)) | counters
        for name, shape in shapes.items():
            found = tensors[name].shape if name in tensors else "nothing"
            if found != shape:
                raise InputError(
                    f"the checkpoint does not fit the field: {name} should have shape {shape}, found {found}; "
                    "train into a new folder"
                )
        return TorchState(
            self._tensor(tensors["parameters"]),
            self._tensor(tensors["first_moment"]),
            self._tensor(tensors["second_moment"]),
            int(tensors["step"]),
            int(tensors["attempt"]),
            int(tensors["attempt_step"]),
            int(tensors["flat_steps"]),
        )

    def renderer(self, state: TorchState, /) -> RayRenderer:
        """Renders rays in normalised coordinates, every sample in the middle of its stratum."""
        networks = self._networks(state.parameters)
        options = self.options

        def render_chunk(origins: Tensor, directions: Tensor) -> list[Tensor]:
            with torch.inference_mode():
                middle = torch.full((len(origins), options.num_samples), 0.5, device=self.device)
                fine_middle = torch.full((len(origins), options.num_fine_samples), 0.5, device=self.device)
                out = render_rays(options, self.frame, networks, origins, directions, middle, fine_middle)[-1]
                return [out.rgb.cpu(), out.depth.cpu(), out.opacity.cpu()]

        def render(rays: Rays, /) -> RenderedRays:
            chunks = [self._tensor(a).split(self.rays_per_chunk) for a in (rays.origins, rays.directions)]
            parts = list(self.workers.map(render_chunk, *chunks))
            rgb, depth, opacity = (torch.cat(column).numpy() for column in zip(*parts, strict=True))
            return RenderedRays(rgb, depth, opacity)

        return render

    def _attempt(self, attempt: int, step: int) -> TorchState:
        rng = np.random.default_rng([self.seed, STREAM_WEIGHTS, attempt])
        weights = [initial_parameters(self.options, rng) for _ in range(self.num_networks)]
        parameters = self._tensor(np.concatenate(weights))
        return TorchState(parameters, torch.zeros_like(parameters), torch.zeros_like(parameters), step, attempt, 0, 0)

    def _batch(self, step: int, rng: np.random.Generator) -> tuple[Rays, Float[np.ndarray, "r 3"]]:
        assert self.rays is not None
        if self.options.rays_per_step is not None:
            return self.rays.batch(rng.integers(len(self.rays), size=self.options.rays_per_step))
        epoch, place = divmod(step, self.rays.num_images)
        order = np.random.default_rng([self.seed, STREAM_ORDER, epoch]).permutation(self.rays.num_images)
        return self.rays.whole_image(int(order[place]))

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)).to(self.device)

    def _networks(self, parameters: Tensor) -> list[dict[str, Tensor]]:
        return [split_parameters(self.options, flat) for flat in parameters.chunk(self.num_networks)]

    def _chunk_loss(
        self, parameters: Tensor, origins: Tensor, directions: Tensor, colors: Tensor, noise: Tensor, fine: Tensor
    ) -> ChunkLoss:
        """Squared errors of a chunk of rays and their gradient."""
        networks = self._networks(parameters)
        leaves = [{name: p.detach().requires_grad_() for name, p in network.items()} for network in networks]
        rendered = render_rays(self.options, self.frame, leaves, origins, directions, noise, fine)
        squared_errors = torch.stack([torch.sum((out.rgb - colors) ** 2) for out in rendered])
        gradient = torch.autograd.grad(squared_errors.sum(), [p for network in leaves for p in network.values()])
        found = squared_errors.detach()
        rgb = rendered[-1].rgb.detach().double()
        return ChunkLoss(
            torch.cat([g.reshape(-1) for g in gradient]),
            float(found.sum()),
            float(found[-1]),
            len(colors),
            rgb.sum(dim=0).cpu().numpy(),
            (rgb**2).sum(dim=0).cpu().numpy(),
        )

    def _updated(
        self, state: TorchState, total: ChunkLoss, colors: Float[np.ndarray, "r 3"]
    ) -> tuple[TorchState, StepReport]:
        """The state after Adam's step, or after a new start."""
        numbers = 3 * total.num_rays
        mse = max(total.squared_error / numbers, 1e-12)
        if self.options.loss == "log_mse":
            loss, gradient = float(np.log(mse)), total.gradient / (mse * numbers)
        else:
            loss, gradient = mse, total.gradient / numbers
        report = StepReport(loss, total.squared_error_final / numbers)
        # Written so that colours that are not finite count as flat.
        has_contrast = total.contrast() >= MIN_CONTRAST * float(np.std(colors, axis=0).max())
        flat_steps = 0 if has_contrast else state.flat_steps + 1
        if flat_steps >= self.max_flat_steps and state.attempt + 1 < MAX_ATTEMPTS:
            logger.warning(
                "the field shows one flat colour since %d steps and would not recover; attempt %d starts afresh",
                flat_steps,
                state.attempt + 2,
            )
            return self._attempt(state.attempt + 1, state.step + 1), report
        parameters, first, second = adam(
            state.parameters,
            state.first_moment,
            state.second_moment,
            gradient,
            step=state.attempt_step + 1,
            learning_rate=self.options.learning_rate_at(state.attempt_step),
        )
        updated = TorchState(
            parameters, first, second, state.step + 1, state.attempt, state.attempt_step + 1, flat_steps
        )
        return updated, report


@dataclass(frozen=True, eq=False)
class ChunkLoss:
    """Squared errors of some rays, summed over rays and channels; `+` joins two chunks."""

    gradient: Float[Tensor, "p"]
    """Of `squared_error` by all parameters."""
    squared_error: float
    """Of the coarse and the fine colours together."""
    squared_error_final: float
    """Of the final colours alone."""
    num_rays: int
    rgb_sum: Float[np.ndarray, "3"]
    rgb_squared_sum: Float[np.ndarray, "3"]

    def __add__(self, other: ChunkLoss) -> ChunkLoss:
        return ChunkLoss(
            self.gradient + other.gradient,
            self.squared_error + other.squared_error,
            self.squared_error_final + other.squared_error_final,
            self.num_rays + other.num_rays,
            self.rgb_sum + other.rgb_sum,
            self.rgb_squared_sum + other.rgb_squared_sum,
        )

    def contrast(self) -> float:
        """Standard deviation of the rendered colours over the rays, of the channel where it is largest."""
        mean = self.rgb_sum / self.num_rays
        variance = self.rgb_squared_sum / self.num_rays - mean**2
        return float(np.sqrt(np.maximum(variance, 0.0).max()))
