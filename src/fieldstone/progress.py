"""What a long run says while it runs: typed events, from every stage, for consoles, logs, notebooks and pipes alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

Item = TypeVar("Item")


@dataclass(frozen=True)
class Progress:
    """How far one stage of a run is."""

    stage: str
    """What is being done, in words: `finding features`, `matching`, `training`."""
    done: float | int = 0
    """Units of the stage that are done: photos, pairs, steps, frames, or seconds of a budget."""
    total: float | int | None = None
    """Units that there are; None where nobody knows."""
    seconds: float = 0.0
    """Wall seconds since the stage began."""
    detail: str = ""
    """What is worth saying beside it, such as the training error."""


OnProgress = Callable[[Progress], None]
"""Receives the events of a run, on the thread that called it, in order."""


def silent(event: Progress) -> None:
    """The `OnProgress` of who wants to hear nothing."""


class StageProgress:
    """Counts the units of one stage and reports each; the first event says that the stage has begun."""

    def __init__(self, on_progress: OnProgress, stage: str, total: float | int | None = None) -> None:
        self._on_progress, self._stage, self._total = on_progress, stage, total
        self._done, self._started = 0, time.perf_counter()
        on_progress(Progress(stage, 0, total))

    def at(self, done: float | int, detail: str = "") -> None:
        """So many units are done."""
        self._done = done
        self._on_progress(Progress(self._stage, done, self._total, self.seconds(), detail))

    def advance(self, detail: str = "") -> None:
        """One more unit is done."""
        self.at(self._done + 1, detail)

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """The items as they come; each counts as done once the next is asked for."""
        for item in items:
            yield item
            self.advance()

    def seconds(self) -> float:
        """Wall seconds since the stage began."""
        return time.perf_counter() - self._started
