"""Threads for kernels that work on ranges."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int


@dataclass(frozen=True)
class Workers:
    """Runs a kernel over ranges, in this thread or in several; the ranges never change a result."""

    pool: ThreadPoolExecutor | None
    threads: int

    def over(self, kernel: Callable, bounds: list[tuple[int, ...]], *args) -> None:
        """Call `kernel(*bound, *args)` for every bound and wait."""
        if self.pool is None or len(bounds) == 1:
            for bound in bounds:
                kernel(*bound, *args)
            return
        futures = [self.pool.submit(kernel, *bound, *args) for bound in bounds]
        for future in futures:
            future.result()

    def split(self, starts: Int[np.ndarray, "n_and_one"]) -> list[tuple[int, ...]]:
        """Ranges of items with about equally many observations."""
        count = len(starts) - 1
        if self.threads == 1:
            return [(0, count)]
        cuts = np.searchsorted(starts, np.linspace(0, starts[-1], self.threads + 1)[1:-1])
        edges = [0, *cuts.tolist(), count]
        return [(a, b) for a, b in pairwise(edges) if b > a] or [(0, count)]


@contextmanager
def started_workers(threads: int) -> Iterator[Workers]:
    """Workers whose threads end with the block."""
    if threads == 1:
        yield Workers(None, 1)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield Workers(pool, threads)
