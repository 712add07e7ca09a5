"""The stages of a plan, one after the other, corrected by the clock, saved and shown on the way."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from fieldstone.field.base.budget import Budget
from fieldstone.field.base.interrupts import deferred_interrupts
from fieldstone.field.base.radiance_field import FieldTraining
from fieldstone.field.base.training import CurvePoint, OnStep, train
from fieldstone.field.grid.exposure import Exposure
from fieldstone.field.grid_training.budget import corrected
from fieldstone.field.grid_training.plan import GridPlan

logger = logging.getLogger(__name__)

MEASURED_STEPS = 12
"""Steps that are tried, and thrown away, to learn how fast the machine is."""

SAVED_AFTER_S = 30.0
"""At the end of a stage, what is older than this is saved."""

P = TypeVar("P", bound="PlannedState")


@runtime_checkable
class PlannedState(Protocol):
    """A state of a training that follows a plan, on whatever device."""

    @property
    def plan(self) -> GridPlan:
        """What is followed."""
        ...

    @property
    def step(self) -> int:
        """Steps done."""
        ...

    @property
    def exposure(self) -> Exposure:
        """Of every photo."""
        ...

    def with_plan(self: P, plan: GridPlan) -> P:
        """The same state, with other steps to come."""
        ...


def train_stages(
    training: FieldTraining[P],
    state: P,
    curve: tuple[CurvePoint, ...],
    *,
    budget: Budget | None,
    max_steps: int | None,
    on_step: OnStep,
    save: Callable[[P, tuple[CurvePoint, ...]], None],
    preview: Callable[[P], None] = lambda state: None,
) -> tuple[P, tuple[CurvePoint, ...]]:
    """Follow the plan of a state to its end, stage by stage.

    Args:
        budget: At the start of each stage, the steps to come are set to what fits into it, and training ends with it;
            None: the plan stands.
    """
    saved = time.perf_counter()

    def keep(state: P, curve: tuple[CurvePoint, ...]) -> None:
        nonlocal saved
        save(state, curve)
        saved = time.perf_counter()

    with deferred_interrupts() as check:
        while state.step < min(state.plan.schedule.total_steps, max_steps or state.plan.schedule.total_steps):
            plan = state.plan
            schedule = plan.schedule
            stage = schedule.stage_of(state.step)
            end = sum(schedule.steps[: stage + 1])
            last = min(end, schedule.total_steps, max_steps or end)
            before, began = state.step, time.perf_counter()
            state, curve = train(
                training,
                state,
                budget=budget or Budget.start(None),
                max_steps=last,
                curve=curve,
                on_step=on_step,
                save=keep,
                save_at_end=False,
                show=preview,
            )
            now = time.perf_counter()
            if state.step < last:
                state = state.with_plan(state.plan.replaced(stop_after=state.step))
                logger.warning("the time is over after %d of %d steps", state.step, sum(schedule.steps))
            elif budget is not None and stage + 1 < len(schedule.steps) and last == end:
                slower = 1.4 if schedule.levels(stage + 1) != schedule.levels(stage) else 1.0
                per_step = slower * (now - began) / (state.step - before)
                state = state.with_plan(corrected(plan, stage + 1, budget.left(), per_step))
                took = now - began
                logger.info(
                    "stage %d: %d steps in %.1f s; plan %s", stage, state.step - before, took, state.plan.schedule.steps
                )
            try:
                check()
            except KeyboardInterrupt:
                save(state, curve)
                raise
            if now - saved > SAVED_AFTER_S and state.step < state.plan.schedule.total_steps:
                keep(state, curve)
        preview(state)
        save(state, curve)
    return state, curve


def measured_step(training: FieldTraining[Any]) -> float:
    """Seconds of a first step on this machine, by trying some."""
    state = training.start()
    times = []
    for _ in range(MEASURED_STEPS):
        began = time.perf_counter()
        state, _ = training.advance(state)
        times.append(time.perf_counter() - began)
    return float(np.median(times[2:]))
