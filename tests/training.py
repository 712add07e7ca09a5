"""Trainings as tests want them: with a folder, without a report, by their metrics."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fieldstone.progress import Progress
from fieldstone.records.field import FieldMetrics
from fieldstone.run.train import train


def trained(source: Path, out: Path, **settings: Any) -> FieldMetrics:
    """The metrics of a training that is kept in a folder."""
    field = train(source, keep_in=out, report=False, **settings)
    assert field.metrics is not None
    return field.metrics


def at_step(step: int, error: type[BaseException]) -> Callable[[Progress], None]:
    """Raises an error when the training reports a step."""

    def listen(event: Progress) -> None:
        if event.detail.startswith(f"step {step},"):
            raise error

    return listen
