"""The training loop that every kind of field shares, and the settings of the classical ones."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from fieldstone.field.base.budget import Budget
from fieldstone.field.base.interrupts import deferred_interrupts
from fieldstone.field.base.radiance_field import FieldTraining, StepReport
from fieldstone.records.field import CurvePoint

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class NetworkOptions:
    """How a network is built, sampled and trained; `TINY` and `NERF` are the two settings that people know."""

    network: Literal["tiny", "nerf"]
    """tiny: 5 layers, ELU. nerf: 8 layers and a colour branch, ReLU, a coarse and a fine one."""
    width: int
    """Units of a hidden layer."""
    position_frequencies: int
    direction_frequencies: int
    image_size_px: int
    """Photos are reduced to this length of their longer side."""
    rays_per_step: int | None
    """Rays of one step, drawn from all photos; None: all rays of one photo, photos in random order."""
    num_samples: int
    """Stratified samples per ray."""
    num_fine_samples: int
    """Further samples, where the coarse network found something; 0: no fine network."""
    learning_rate: float
    final_learning_rate: float
    decay_steps: int
    """The learning rate falls exponentially, from the first to the final value over this many steps."""
    loss: Literal["mse", "log_mse"]

    def __post_init__(self) -> None:
        if min(self.width, self.image_size_px, self.num_samples, self.decay_steps) < 1 or self.num_fine_samples < 0:
            raise ValueError(f"sizes and counts must be positive, got {self}")
        if not 0 < self.final_learning_rate <= self.learning_rate:
            raise ValueError(f"learning rates must be positive and not grow, got {self}")
        if self.rays_per_step is not None and self.rays_per_step < 1:
            raise ValueError(f"rays_per_step must be positive or None, got {self.rays_per_step}")

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of the step after `step` steps."""
        share = min(step / self.decay_steps, 1.0)
        return self.learning_rate * (self.final_learning_rate / self.learning_rate) ** share


TINY = NetworkOptions(
    network="tiny",
    width=128,
    position_frequencies=6,
    direction_frequencies=6,
    image_size_px=100,
    rays_per_step=None,
    num_samples=32,
    num_fine_samples=0,
    learning_rate=5e-3,
    final_learning_rate=5e-3,
    decay_steps=1,
    loss="log_mse",
)
"""The small network of the course: 100x100 photos, one whole photo per step, 32 samples, loss log(MSE)."""

NERF = NetworkOptions(
    network="nerf",
    width=256,
    position_frequencies=10,
    direction_frequencies=4,
    image_size_px=400,
    rays_per_step=256,
    num_samples=64,
    num_fine_samples=128,
    learning_rate=5e-4,
    final_learning_rate=5e-5,
    decay_steps=250_000,
    loss="mse",
)
"""The original NeRF, `mildenhall2020`: its networks, samples, loss and learning rate; 256 rays a step, not 4096."""

PRESETS = {"tiny": TINY, "nerf": NERF}


OnStep = Callable[[CurvePoint], None]

S = TypeVar("S")


def train(
    training: FieldTraining[S],
    state: S,
    *,
    budget: Budget,
    max_steps: int | None = None,
    curve: tuple[CurvePoint, ...] = (),
    on_step: OnStep = lambda point: None,
    save: Callable[[S, tuple[CurvePoint, ...]], None] = lambda state, curve: None,
    save_every_s: float = 60.0,
    show: Callable[[S], None] = lambda state: None,
    show_every_s: float = 10.0,
    save_at_end: bool = True,
) -> tuple[S, tuple[CurvePoint, ...]]:
    """Step until the budget or the number of steps is used up; `save` is called now and then, and at the end.

    An interruption saves too, after the step that it came in.

    Args:
        state: Where to start; after a stop, what the checkpoint holds.
        budget: Training ends when it is over, but not before one step was done in all.
        max_steps: Steps in all, those of `curve` included; None: no limit.
        curve: The steps done before.
        show: Is called now and then, for a picture of what there is.
        save_at_end: False leaves the last state to the caller, who goes on with it.

    Returns:
        The last state, and the curve of all steps.

    Raises:
        ValueError: Neither a budget nor a number of steps.
    """
    if not budget.is_limited and max_steps is None:
        raise ValueError("training needs a budget in seconds or a number of steps")
    points = list(curve)
    before = points[-1].seconds if points else 0.0
    start = last_save = last_show = time.perf_counter()
    paused = 0.0
    with deferred_interrupts() as check:
        try:
            while (max_steps is None or len(points) < max_steps) and (not points or budget.left() > 0):
                state, report = training.advance(state)
                now = time.perf_counter()
                points.append(_curve_point(len(points) + 1, before + now - start - paused, report))
                on_step(points[-1])
                if now - last_show > show_every_s:
                    show(state)
                    last_show = time.perf_counter()
                if now - last_save > save_every_s:
                    save(state, tuple(points))
                    last_save = time.perf_counter()
                    paused += last_save - now
                check()
        except KeyboardInterrupt:
            logger.warning("interrupted after %d steps; they are kept", len(points))
            save(state, tuple(points))
            raise
    if save_at_end:
        save(state, tuple(points))
    return state, tuple(points)


def _curve_point(step: int, seconds: float, report: StepReport) -> CurvePoint:
    """A step whose numbers are not finite is the worst that a curve can show: PSNR 0."""
    if not np.isfinite(report.loss) or not np.isfinite(report.mse):
        return CurvePoint(step, seconds, 0.0, 0.0)
    return CurvePoint(step, seconds, report.loss, float(-10.0 * np.log10(max(report.mse, 1e-12))))
