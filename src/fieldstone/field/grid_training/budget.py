"""What a budget in seconds becomes: the first plan of a scene, its steps, and their correction by the clock."""

from __future__ import annotations

import numpy as np

from fieldstone.field.grid_training.plan import (
    MAX_FINEST,
    NUM_STAGES,
    STAGE_FRACTIONS,
    GridPlan,
    Schedule,
)


def finest_for(budget_s: float, extent: float, pixel_size: float) -> int:
    """Cells along the longest side that the photos can show and the budget can fill.

    More than three cells for two pixels are not seen; the number of cells at a surface grows with the square of the
    resolution and the steps that they need with it, so that a budget eight times as long carries twice as many.

    Args:
        pixel_size: Width of a pixel at the distance of the scene, in the unit of extent.
    """
    visible = 1.5 * extent / pixel_size
    affordable = 160.0 * (budget_s / 8.0) ** (1.0 / 3.0)
    return int(np.clip(min(visible, affordable), 16, MAX_FINEST))


LARGE_BATCHES = ((30.0, 2048), (240.0, 4096))
"""Budgets in seconds from which a chunk has so many samples: the noise of small batches is what long runs end in."""


SMALL_FINEST = 160
"""Up to so many cells, many samples of a batch meet in a vertex of the finest level: moving it by each of them is
noise, by their sum is not."""

SMALL_FINAL_RATE_RATIO = 0.03
"""Final learning-rate ratio on such grids: every ray is seen many times, and what the last ones say is noise."""


OPEN_SCENE = {
    "box_warm_up": False,
    "density_bias": -3.0,
    "prune_density": 0.01,
    "min_weight": 4e-3,
    "clear_initial_density_from": 4,
    "emptiness": 0.0,
    "exposure_rate": 0.005,
    "sparse_depth_weight": 0.5,
    "free_space_weight": 0.01,
    "clear_floaters_from": 3,
    "weight_decay": 0.06,
}
"""Settings of scenes that fill their space."""


def first_plan(finest: int, budget_s: float, *, bounded: bool) -> GridPlan:
    """The settings for a kind of scene and a budget, with steps that are still to be planned.

    Args:
        bounded: The scene is an object in a box. Others fill their space: there is no box to be found around them,
            and surfaces without texture, which take long to be found, must not be given up early.
    """
    plan = GridPlan(Schedule(finest=finest, steps=(1000,) * NUM_STAGES))
    plan = plan.replaced(
        samples_per_chunk=max([1024, *(samples for from_s, samples in LARGE_BATCHES if budget_s >= from_s)])
    )
    if not bounded:
        return plan.replaced(**OPEN_SCENE)
    if finest <= SMALL_FINEST:
        plan = plan.replaced(final_rate_ratio=SMALL_FINAL_RATE_RATIO, immediate_levels=0)
    return plan.replaced(weight_decay=0.01)


def plan_for_budget(plan: GridPlan, budget_s: float, spent_s: float, seconds_per_step: float) -> GridPlan:
    """The plan with stages that take their fractions of what is left of a budget.

    Args:
        spent_s: Already gone for reading and preparing.
        seconds_per_step: Of a step in the first stage, measured.
    """
    left = max(budget_s - spent_s, 0.05)
    slower = [1.0, 1.3] + [1.7] * (NUM_STAGES - 2)
    steps = tuple(
        max(round(left * fraction / (seconds_per_step * factor)), 1)
        for fraction, factor in zip(STAGE_FRACTIONS, slower, strict=True)
    )
    return plan.replaced(steps=steps)


def corrected(plan: GridPlan, stage: int, left_s: float, seconds_per_step: float) -> GridPlan:
    """The plan with the steps of `stage` and all later ones set to what is left of the budget.

    Args:
        seconds_per_step: Expected for `stage`.
    """
    fractions = STAGE_FRACTIONS[stage:]
    steps = [max(round(max(left_s, 0.0) * part / sum(fractions) / seconds_per_step), 1) for part in fractions]
    return plan.replaced(steps=plan.schedule.steps[:stage] + tuple(steps))
