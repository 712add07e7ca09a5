"""What a time budget buys: grids, steps, rates and losses of a run of the grid field, decided in one place.

Training goes through stages of growing resolution. A plan fixes the number of steps of each stage; the same plan gives
the same bytes, however often the run is interrupted. A budget in seconds becomes a plan by measuring the first steps
on the machine at hand; at the start of a stage, the steps of the stages to come are corrected once more by what the
last stage really took. What was done is what the plan says.

A plan is four values: when grids change (`Schedule`), how far parameters move (`LearningRates`), what counts
(`LossWeights`) and where rays are sampled (`Sampling`). In files it is one flat object; `FILE_KEYS` is the only place
that knows its keys.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from fieldstone.field.grid.layout import level_resolutions
from fieldstone.field.grid.terms_numba import Terms

STAGE_FRACTIONS = (0.08, 0.12, 0.2, 0.2, 0.18, 0.12, 0.06, 0.04)
"""Fraction of the training time of each stage; late ones are short, so that the last correction leaves little to
guess."""

NUM_STAGES = len(STAGE_FRACTIONS)

STAGE_HALVINGS = (2, 1, 0, 0, 0, 0, 0, 0)
"""How often the finest resolution is halved in each stage."""

PRUNE_AT = (0.25, 0.6)
"""Fractions of a stage after which empty cells are given up; also when a stage begins."""

LAST_PRUNED = 4
"""Stages after this one give up cells when they begin, and not again: there is hardly anything left to give up."""

MIN_STEPS = 60
"""No cell is given up before so many steps."""

COARSEST_LEVEL = 14
"""Levels go down to about this many cells along the longest side."""

MAX_FINEST = 384
"""Cells of the finest level along the longest side: 32 bytes each, dense, fit the memory of a laptop."""


@dataclass(frozen=True)
class Schedule:
    """How many steps there are, and what changes between them."""

    finest: int
    """Cells along the longest side of the box in the finest level."""
    steps: tuple[int, ...]
    """Steps of each stage."""
    box_warm_up: bool = True
    """The first stage only finds out where something is; then training begins again, in a box around it."""
    prune_density: float = 0.05
    """Cells with less than this everywhere are given up. More than the initial density: what no ray has asked for by
    then goes too."""
    clear_initial_density_from: int = NUM_STAGES
    """From this stage on, cells that are no denser than at the start are given up too."""
    clear_floaters_from: int = NUM_STAGES
    """From this stage on, solid pieces that are tied to nothing are given up, where there are sparse depths."""
    refine_poses: bool = False
    """Refine the poses of the photos between stages so that the field fits them, see `pose_refinement`."""
    stop_after: int | None = None
    """Where training stopped because the time was over, if the machine became slower than any correction foresaw."""

    def __post_init__(self) -> None:
        if len(self.steps) != NUM_STAGES or any(type(n) is not int or n < 1 for n in self.steps):
            raise ValueError(f"a plan needs {NUM_STAGES} stages of at least one step, got {self.steps}")
        _check_numbers(self, positive=(), counts=("finest",))

    @property
    def total_steps(self) -> int:
        """Steps of all stages, up to the stop."""
        return min(sum(self.steps), self.stop_after or sum(self.steps))

    def stage_of(self, step: int) -> int:
        """The stage that step number `step` (from 0) belongs to."""
        return min(int(np.searchsorted(np.cumsum(self.steps), step, side="right")), len(self.steps) - 1)

    def place(self, step: int) -> tuple[int, int]:
        """The stage of step number `step`, and how many steps of this stage come before it."""
        stage = self.stage_of(step)
        return stage, step - sum(self.steps[:stage])

    def prunes_at(self, step: int) -> bool:
        """Whether empty cells are given up before step number `step`."""
        stage, into_stage = self.place(step)
        prune = into_stage == 0 and stage > 0
        if stage <= LAST_PRUNED:
            prune |= any(into_stage == int(fraction * self.steps[stage]) > 0 for fraction in PRUNE_AT)
        return prune and step >= MIN_STEPS

    def levels(self, stage: int) -> tuple[int, ...]:
        """Resolutions of the levels that a stage has, coarse to fine."""
        final = level_resolutions(self.finest, COARSEST_LEVEL)
        return final[: max(len(final) - STAGE_HALVINGS[stage], 1)]

    def progress(self, step: int) -> float:
        """Fraction of the training time before step number `step`: time, not steps, drives the learning rates."""
        stage, into_stage = self.place(step)
        done = sum(STAGE_FRACTIONS[:stage]) + STAGE_FRACTIONS[stage] * into_stage / self.steps[stage]
        return min(done, 1.0)


@dataclass(frozen=True)
class LearningRates:
    """How far a step moves the parameters, at the start of training."""

    density_rate: float = 0.15
    """Step of a log density."""
    feature_rate: float = 0.035
    decoder_rate: float = 0.02
    exposure_rate: float = 0.0
    """Step of the logarithm of a photo's exposure; 0: all photos are alike."""
    final_rate_ratio: float = 0.15
    """All rates fall exponentially to this fraction of what they were."""
    mean_square_decay: float = 0.98
    """Memory of the mean squared gradients of the grids."""
    weight_decay: float = 0.0
    """What the log density of a vertex of the finest level loses with every step, as a fraction of itself by rate;
    coarser levels lose less, the coarsest nothing. Fine levels then add to coarse ones only what photos insist on."""
    immediate_levels: int = 1
    """Finest levels that are stepped sample by sample."""

    def __post_init__(self) -> None:
        rates = ("density_rate", "feature_rate", "decoder_rate", "final_rate_ratio", "mean_square_decay")
        _check_numbers(self, positive=rates, counts=())


@dataclass(frozen=True)
class LossWeights:
    """What counts besides the squared colour error of a ray, in units of it; see `terms_numba.Terms`."""

    sparsity: float = 2e-3
    """Of the opacity of a ray."""
    emptiness: float = 2e-3
    """Of what stands on rays that show exactly the background, where photos of an object have no alpha."""
    sparse_depth_weight: float = 0.0
    """Of light that misses the triangulated point on its ray; falls with the learning rates."""
    free_space_weight: float = 0.0
    """Of light that ends early, for what the triangulated points around a ray say."""

    def __post_init__(self) -> None:
        _check_numbers(self, positive=(), counts=())

    def terms(self, rate_multiplier: float, *, alpha_known: bool) -> Terms:
        """The weights of one step.

        Args:
            rate_multiplier: Of the learning rates at this step.
            alpha_known: Photos say themselves where they show the background.
        """
        return Terms(
            sparsity=np.float32(self.sparsity),
            emptiness=np.float32(0.0 if alpha_known else self.emptiness),
            sparse_depth=np.float32(self.sparse_depth_weight * rate_multiplier),
            free_space=np.float32(self.free_space_weight),
        )


@dataclass(frozen=True)
class Sampling:
    """Which rays a step draws, and where they are sampled."""

    num_chunks: int = 8
    """Parts that a step is split into, one or more for each thread; fixed, so that threads never change a result."""
    samples_per_chunk: int = 1024
    step_cells: float = 1.0
    """Distance between samples, in cells of the finest level."""
    min_weight: float = 8e-3
    """Samples that give less to the pixel than this are left out."""
    early_stop_eps: float = 1e-2
    """A ray ends where less transmittance than this is left."""
    density_bias: float = -4.5
    """Log density of the start: a ray then loses about 1 % of its light per 1/128 of the box."""

    def __post_init__(self) -> None:
        _check_numbers(
            self,
            positive=("step_cells", "min_weight", "early_stop_eps"),
            counts=("num_chunks", "samples_per_chunk"),
        )


@dataclass(frozen=True)
class GridPlan:
    """Everything that decides the result of a run, with the seed and the photos."""

    schedule: Schedule
    rates: LearningRates = field(default_factory=LearningRates)
    losses: LossWeights = field(default_factory=LossWeights)
    sampling: Sampling = field(default_factory=Sampling)

    def replaced(self, **settings: Any) -> GridPlan:
        """The plan with other settings, by name, whichever of its parts they belong to; names are unique."""
        return _with_settings(self, settings)

    def rate_multiplier(self, step: int) -> float:
        """What step number `step` multiplies all learning rates by."""
        return float(self.rates.final_rate_ratio ** self.schedule.progress(step))

    def to_settings(self) -> dict[str, Any]:
        """All settings, flat, by the keys of plan.json."""
        return {key: getattr(getattr(self, part), name) for key, (part, name) in FILE_KEYS.items()}

    def to_json(self) -> str:
        """All settings, for `plan_from_json`."""
        return json.dumps(self.to_settings(), sort_keys=True)


FILE_KEYS: dict[str, tuple[str, str]] = {
    "finest": ("schedule", "finest"),
    "steps": ("schedule", "steps"),
    "num_chunks": ("sampling", "num_chunks"),
    "samples_per_chunk": ("sampling", "samples_per_chunk"),
    "density_rate": ("rates", "density_rate"),
    "feature_rate": ("rates", "feature_rate"),
    "decoder_rate": ("rates", "decoder_rate"),
    "final_rate": ("rates", "final_rate_ratio"),
    "decay": ("rates", "mean_square_decay"),
    "raw_offset": ("sampling", "density_bias"),
    "step_cells": ("sampling", "step_cells"),
    "min_weight": ("sampling", "min_weight"),
    "min_light": ("sampling", "early_stop_eps"),
    "prune_density": ("schedule", "prune_density"),
    "clear_fog_from": ("schedule", "clear_initial_density_from"),
    "fine_decay": ("rates", "weight_decay"),
    "immediate_levels": ("rates", "immediate_levels"),
    "scout": ("schedule", "box_warm_up"),
    "sparsity": ("losses", "sparsity"),
    "emptiness": ("losses", "emptiness"),
    "clear_floaters_from": ("schedule", "clear_floaters_from"),
    "exposure_rate": ("rates", "exposure_rate"),
    "point_weight": ("losses", "sparse_depth_weight"),
    "free_weight": ("losses", "free_space_weight"),
    "refine_poses": ("schedule", "refine_poses"),
    "stop_after": ("schedule", "stop_after"),
}
"""Key in plan.json and in checkpoints: part of the plan, and name there. Files outlive names."""

_KEY_OF = {name: key for key, (_, name) in FILE_KEYS.items()}
_PART_OF = {name: part for part, name in FILE_KEYS.values()}


def plan_from_json(text: str) -> GridPlan:
    """The plan of `GridPlan.to_json`; settings that a file does not have are those of before they existed.

    Raises:
        ValueError: Not a plan.
    """
    try:
        settings = json.loads(text)
        by_name = {FILE_KEYS[key][1]: value for key, value in settings.items()}
        schedule = Schedule(finest=by_name.pop("finest"), steps=tuple(by_name.pop("steps")))
        return _with_settings(GridPlan(schedule), by_name)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a plan of the grid field: {error}") from error


def _with_settings(plan: GridPlan, settings: dict[str, Any]) -> GridPlan:
    by_part: dict[str, dict[str, Any]] = {}
    for name, value in settings.items():
        by_part.setdefault(_PART_OF[name], {})[name] = value
    return replace(plan, **{part: replace(getattr(plan, part), **values) for part, values in by_part.items()})


def _check_numbers(
    part: Schedule | LearningRates | LossWeights | Sampling, positive: Sequence[str], counts: Sequence[str]
) -> None:
    """Numbers are finite, and whole where they count something.

    Args:
        positive: Settings that are greater than 0.
        counts: Settings that are at least 1.

    Raises:
        ValueError: One is not; it is named as in plan.json.
    """
    for setting in fields(part):
        name, value = _KEY_OF[setting.name], getattr(part, setting.name)
        if setting.type == "float" and not (type(value) in (int, float) and np.isfinite(value)):
            raise ValueError(f"{name} must be a finite number, got {value!r}")
        if setting.name in positive and not value > 0:
            raise ValueError(f"{name} must be greater than 0, got {value!r}")
        if setting.type == "int" and (type(value) is not int or value < (setting.name in counts)):
            raise ValueError(f"{name} must be a whole number, got {value!r}")
