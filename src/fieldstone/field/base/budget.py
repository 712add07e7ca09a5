"""The time that a run may take, on one clock."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """Wall seconds, and since when they run."""

    seconds: float
    """inf: no limit."""
    began: float
    """As `time.perf_counter` has it."""

    @staticmethod
    def start(seconds: float | None) -> Budget:
        """A budget that runs from now on; None: no limit."""
        return Budget(math.inf if seconds is None else seconds, time.perf_counter())

    def spent(self) -> float:
        """Seconds since it began."""
        return time.perf_counter() - self.began

    def left(self) -> float:
        """Seconds that remain; negative when it is over."""
        return self.seconds - self.spent()

    def part(self, fraction: float) -> Budget:
        """A fraction of it, on the same clock."""
        return Budget(fraction * self.seconds, self.began)

    @property
    def is_limited(self) -> bool:
        """Whether it can run out."""
        return math.isfinite(self.seconds)
