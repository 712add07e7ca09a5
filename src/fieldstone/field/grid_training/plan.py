"""What a time budget buys: grids, steps and learning rates of a run of the fast field, decided in one place.

Training goes through stages of growing resolution. A plan fixes the number of steps of each stage; the same plan gives
the same bytes, however often the run is interrupted. A budget in seconds becomes a plan by measuring the first steps
on the machine at hand; at the start of a stage, the steps of the stages to come are corrected once more by what the
last stage really took. What was done is what the plan says.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from fieldstone.field.grid.layout import level_resolutions

STAGE_SHARES = (0.08, 0.12, 0.2, 0.2, 0.18, 0.12, 0.06, 0.04)
"""Share of the training time of each stage; late ones are short, so that the last correction leaves little to guess."""

STAGE_HALVINGS = (2, 1, 0, 0, 0, 0, 0, 0)
"""How often the finest resolution is halved in each stage."""

PRUNE_AT = (0.25, 0.6)
"""Shares of a stage after which empty cells are given up; also when a stage begins."""

LAST_PRUNED = 4
"""Stages after this one give up cells when they begin, and not again: there is hardly anything left to give up."""

MIN_STEPS = 60
"""No cell is given up before so many steps."""

COARSEST_LEVEL = 14
"""Levels go down to about this many cells along the longest side."""

MAX_FINEST = 384
"""Cells of the finest level along the longest side: 32 bytes each, dense, fit the memory of a laptop."""


POSITIVE = (
    "density_rate", "feature_rate", "decoder_rate", "final_rate", "decay", "step_cells", "min_weight", "min_light"
)  # fmt: skip
COUNTS = ("finest", "num_chunks", "samples_per_chunk")
"""Settings that are at least 1."""


@dataclass(frozen=True)
class FastPlan:
    """Everything that decides the result of a run, with the seed and the photos."""

    finest: int
    """Cells along the longest side of the box in the finest level."""
    steps: tuple[int, ...]
    """Steps of each stage."""
    num_chunks: int = 8
    """Parts that a step is split into, one or more for each thread; fixed, so that threads never change a result."""
    samples_per_chunk: int = 1024
    density_rate: float = 0.15
    """Step of a raw density, at the start of training."""
    feature_rate: float = 0.035
    decoder_rate: float = 0.02
    final_rate: float = 0.15
    """Learning rates fall exponentially to this share."""
    decay: float = 0.98
    """Memory of the mean squared gradients of the grids."""
    raw_offset: float = -4.5
    """Raw density of the start: a ray then loses about 1 % of its light per 1/128 of the box."""
    step_cells: float = 1.0
    """Distance between samples, in cells of the finest level."""
    min_weight: float = 8e-3
    min_light: float = 1e-2
    prune_density: float = 0.05
    """Cells with less than this everywhere are given up. More than the density of the start: what no ray has asked for
    by then goes too."""
    clear_fog_from: int = len(STAGE_SHARES)
    """From this stage on, cells that are no denser than at the start are given up too."""
    fine_decay: float = 0.0
    """What the density of a vertex of the finest level gives up with every step, as a share of itself by rate; coarser
    levels give up less, the coarsest nothing. Fine levels then add to coarse ones only what photos insist on."""
    immediate_levels: int = 1
    """Finest levels that move sample by sample."""
    scout: bool = True
    """The first stage only finds out where something is; then training begins again, in a box around it."""
    sparsity: float = 2e-3
    """Weight of the opacity of a ray against its squared colour error."""
    emptiness: float = 2e-3
    """Weight of what stands on rays that show exactly the background, where photos of an object have no alpha."""
    clear_floaters_from: int = len(STAGE_SHARES)
    """From this stage on, solid pieces that are tied to nothing are given up, where points are known."""
    exposure_rate: float = 0.0
    """Step of the logarithm of a photo's exposure, at the start of training; 0: all photos are alike."""
    point_weight: float = 0.0
    """Weight of light that misses a known point against the squared colour error of its ray; falls with the rates."""
    free_weight: float = 0.0
    """Weight of light that ends early, for what the known points around a ray say, against its squared colour error."""
    refine_poses: bool = False
    """Move the photos between stages so that the field fits them, see `pose_refinement`."""
    stop_after: int | None = None
    """Where training stopped because the time was over, if the machine became slower than any correction foresaw."""

    def __post_init__(self) -> None:
        if len(self.steps) != len(STAGE_SHARES) or any(type(n) is not int or n < 1 for n in self.steps):
            raise ValueError(f"a plan needs {len(STAGE_SHARES)} stages of at least one step, got {self.steps}")
        for setting in fields(self):
            value = getattr(self, setting.name)
            if setting.type == "float" and not (type(value) in (int, float) and np.isfinite(value)):
                raise ValueError(f"{setting.name} must be a finite number, got {value!r}")
            if setting.name in POSITIVE and not value > 0:
                raise ValueError(f"{setting.name} must be greater than 0, got {value!r}")
            if setting.type == "int" and (type(value) is not int or value < (setting.name in COUNTS)):
                raise ValueError(f"{setting.name} must be a whole number, got {value!r}")

    @property
    def total_steps(self) -> int:
        """Steps of all stages, up to the stop."""
        return min(sum(self.steps), self.stop_after or sum(self.steps))

    def to_json(self) -> str:
        """All settings, for `plan_from_json`."""
        return json.dumps(asdict(self), sort_keys=True)

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
            prune |= any(into_stage == int(share * self.steps[stage]) > 0 for share in PRUNE_AT)
        return prune and step >= MIN_STEPS

    def levels(self, stage: int) -> tuple[int, ...]:
        """Resolutions of the levels that a stage has, coarse to fine."""
        final = level_resolutions(self.finest, COARSEST_LEVEL)
        return final[: max(len(final) - STAGE_HALVINGS[stage], 1)]

    def rate_share(self, step: int) -> float:
        """Share of the first learning rate that step number `step` uses: time, not steps, drives the decay."""
        stage = self.stage_of(step)
        before = sum(self.steps[:stage])
        progress = sum(STAGE_SHARES[:stage]) + STAGE_SHARES[stage] * (step - before) / self.steps[stage]
        return float(self.final_rate ** min(progress, 1.0))


def plan_from_json(text: str) -> FastPlan:
    """The plan of `FastPlan.to_json`.

    Raises:
        ValueError: Not a plan.
    """
    try:
        settings = json.loads(text)
        return FastPlan(**{**settings, "steps": tuple(settings["steps"])})
    except (TypeError, KeyError) as error:
        raise ValueError(f"not a plan of the fast field: {error}") from error


def finest_for(budget_s: float, extent: float, pixel_size: float) -> int:
    """Cells along the longest side that the photos can show and the budget can fill.

    More than three cells for two pixels are not seen; the number of cells at a surface grows with the square of the
    resolution and the steps that they need with it, so that a budget eight times as long carries twice as many.

    Args:
        pixel_size: Width of a pixel at the distance of the scene, in the unit of extent.
    """
    seen = 1.5 * extent / pixel_size
    affordable = 160.0 * (budget_s / 8.0) ** (1.0 / 3.0)
    return int(np.clip(min(seen, affordable), 16, MAX_FINEST))


LARGE_BATCHES = ((30.0, 2048), (240.0, 4096))
"""Budgets in seconds from which a chunk has so many samples: the noise of small batches is what long runs end in."""


SMALL_FINEST = 160
"""Up to so many cells, many samples of a batch meet in a vertex of the finest level: moving it by each of them is
noise, by their sum is not."""

SMALL_FINAL_RATE = 0.03
"""Final share of the rates on such grids: every ray is seen many times, and what the last ones say is noise."""


def first_plan(finest: int, budget_s: float, *, bounded: bool) -> FastPlan:
    """The settings for a kind of scene and a budget, with steps that are still to be planned.

    Args:
        bounded: The scene is an object in a box. Others fill their space: there is no box to be found around them,
            and surfaces without texture, which take long to be found, must not be given up early.
    """
    steps = (1000,) * len(STAGE_SHARES)
    room = max([1024, *(samples for from_s, samples in LARGE_BATCHES if budget_s >= from_s)])
    if bounded:
        if finest <= SMALL_FINEST:
            return FastPlan(
                finest, steps, samples_per_chunk=room, final_rate=SMALL_FINAL_RATE, immediate_levels=0, fine_decay=0.01
            )
        return FastPlan(finest, steps, samples_per_chunk=room, fine_decay=0.01)
    return FastPlan(
        finest, steps, samples_per_chunk=room, scout=False, raw_offset=-3.0, prune_density=0.01, min_weight=4e-3,
        clear_fog_from=4, emptiness=0.0, exposure_rate=0.005, point_weight=0.5, free_weight=0.01, clear_floaters_from=3,
        fine_decay=0.06,
    )  # fmt: skip


def plan_for_budget(plan: FastPlan, budget_s: float, spent_s: float, seconds_per_step: float) -> FastPlan:
    """The plan with stages that take their shares of what is left of a budget.

    Args:
        spent_s: Already gone for reading and preparing.
        seconds_per_step: Of a step in the first stage, measured.
    """
    left = max(budget_s - spent_s, 0.05)
    slower = [1.0, 1.3] + [1.7] * (len(STAGE_SHARES) - 2)
    steps = tuple(
        max(round(left * share / (seconds_per_step * factor)), 1)
        for share, factor in zip(STAGE_SHARES, slower, strict=True)
    )
    return replace(plan, steps=steps)


def corrected(plan: FastPlan, stage: int, left_s: float, seconds_per_step: float) -> FastPlan:
    """The plan with the steps of `stage` and all later ones set to what is left of the budget.

    Args:
        seconds_per_step: Expected for `stage`.
    """
    shares = STAGE_SHARES[stage:]
    steps = [max(round(max(left_s, 0.0) * share / sum(shares) / seconds_per_step), 1) for share in shares]
    return replace(plan, steps=plan.steps[:stage] + tuple(steps))
