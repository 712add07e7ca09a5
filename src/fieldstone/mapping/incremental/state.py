"""What incremental registration passes from step to step, and what it ends with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool

from fieldstone.mapping.incremental.options import RETRY_STAGES, IncrementalOptions, RetryStage
from fieldstone.mapping.model.calibration import CalibrationStep
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph


@dataclass(frozen=True, eq=False)
class RegistrationTask:
    """What stays the same while one sub-model is extended."""

    graph: MatchGraph
    """Verified: `two_views` hold the geometry and inliers of every pair."""
    available: Bool[np.ndarray, "n"]
    """Photos that may take part: those that no other sub-model holds."""
    calibration: tuple[CalibrationStep | None, ...]
    """Per camera, what a global adjustment may refine; None keeps its intrinsics as they are."""
    options: IncrementalOptions
    seed: int
    on_registered: Callable[[int], None] = lambda count: None
    """Told how many photos the sub-model has, whenever there is one more."""


@dataclass(frozen=True, eq=False)
class RegistrationState:
    """Where the registration of one sub-model is: steps take a state and return the next, none writes into it."""

    model: WorkingModel
    num_at_global: int
    """Registered photos at the last global adjustment."""
    retry_stage: int = 0
    """Index into `RETRY_STAGES`."""
    tried: frozenset[int] = frozenset()
    """Photos that failed since the last global adjustment: a better model may take what a worse one could not."""
    reasons: Mapping[int, str] = field(default_factory=dict)
    """Per registered photo, the numbers of its registration."""
    failures: Mapping[int, str] = field(default_factory=dict)
    """Per photo that was tried and is not registered, the numbers of its last attempt."""

    @staticmethod
    def start(model: WorkingModel, reasons: Mapping[int, str]) -> RegistrationState:
        """The state of a model that has just been adjusted globally."""
        return RegistrationState(model, model.num_registered, reasons=dict(reasons))

    @property
    def thresholds(self) -> RetryStage:
        """Those of the present retry stage."""
        return RETRY_STAGES[self.retry_stage]

    @property
    def in_last_stage(self) -> bool:
        """Whether thresholds cannot be relaxed any further."""
        return self.retry_stage == len(RETRY_STAGES) - 1

    def unregistered(self, available: Bool[np.ndarray, "n"]) -> list[int]:
        """Available photos without a pose."""
        return np.flatnonzero(available & ~self.model.registered).tolist()

    def at_stage(self, retry_stage: int) -> RegistrationState:
        """The state at the begin of a retry stage, in which every photo may be tried again."""
        return replace(self, retry_stage=retry_stage, tried=frozenset())

    def with_registered(self, view: int, model: WorkingModel, reason: str) -> RegistrationState:
        """The state with a model that holds one more photo."""
        failures = {v: text for v, text in self.failures.items() if v != view}
        return replace(self, model=model, reasons={**self.reasons, view: reason}, failures=failures)

    def with_failure(self, view: int, reason: str) -> RegistrationState:
        """The state after an attempt that failed, with its model as it was."""
        return replace(self, tried=self.tried | {view}, failures={**self.failures, view: reason})

    def after_global_adjustment(self) -> RegistrationState:
        """The state in which every photo may be tried again, for the whole model has been adjusted."""
        return replace(self, num_at_global=self.model.num_registered, tried=frozenset())


@dataclass(frozen=True, eq=False)
class SubModel:
    """Photos that hang together, registered but not yet finished: what one incremental registration ends with."""

    model: WorkingModel
    initial_pair: ImagePair
    """The pair that it started from."""
    reasons: Mapping[int, str]
    """Per registered photo, the numbers of its registration."""
    failures: Mapping[int, str]
    """Per photo that was tried and not registered, the numbers of its last attempt."""
    calibration: tuple[CalibrationStep | None, ...]
    """Per camera, what was refined on the way."""

    @property
    def num_registered(self) -> int:
        """Photos with a pose."""
        return self.model.num_registered


def largest_first(sub_models: list[SubModel]) -> list[SubModel]:
    """In the order of their photos, most first; equals stay in the order in which they were found."""
    return sorted(sub_models, key=lambda sub_model: -sub_model.num_registered)
