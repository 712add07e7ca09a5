"""What got slower or worse since a baseline: `python -m benchmarks.compare BASELINE [NEW] [--slack 1.0]`.

BASELINE and NEW are files of rows or folders of them: `benchmarks/results` is the committed baseline, and
`out/benchmarks`, where benchmarks write, is NEW where it is not given. A metric with
a peer is judged by its ratio to the peer, which stays the same on a slower or busier machine; another one by its value,
and only where both were measured on one machine. The exit code is 1 where anything got worse.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.rows import NEW_ROWS, Row, read_rows

Verdict = Literal["worse", "better", "same", "gone", "new", "not comparable"]


@dataclass(frozen=True)
class Change:
    """A metric before and after."""

    metric: str
    verdict: Verdict
    before: float | None = None
    after: float | None = None
    compared: str = ""
    """What the two numbers are: a unit, or "x PEER" for a ratio."""

    def __str__(self) -> str:
        numbers = [f"{x:.6g}" for x in (self.before, self.after) if x is not None]
        return f"{self.verdict:15s} {self.metric:48s} {' -> '.join(numbers)} {self.compared}".rstrip()


def main(arguments: Sequence[str] | None = None) -> int:
    """Print every change, worse ones first, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("baseline", type=Path)
    parser.add_argument("new", type=Path, nargs="?", default=NEW_ROWS)
    parser.add_argument("--slack", type=float, default=1.0, help="times the tolerance of every metric")
    given = parser.parse_args(arguments)
    changes = compare(read_rows(given.baseline), read_rows(given.new), given.slack)
    order: list[Verdict] = ["worse", "gone", "not comparable", "new", "better", "same"]
    for change in sorted(changes, key=lambda change: order.index(change.verdict)):
        sys.stdout.write(f"{change}\n")
    counts = {verdict: sum(change.verdict == verdict for change in changes) for verdict in order}
    sys.stdout.write(", ".join(f"{count} {verdict}" for verdict, count in counts.items()) + "\n")
    return int(counts["worse"] > 0)


def compare(baseline: Sequence[Row], new: Sequence[Row], slack: float = 1.0) -> list[Change]:
    """Every metric of either side, and whether it got worse by more than `slack` times its tolerance."""
    before, after = ({row.metric: row for row in rows} for rows in (baseline, new))
    changes = [judge(before[metric], after[metric], slack) for metric in before if metric in after]
    changes += [Change(metric, "gone") for metric in before if metric not in after]
    return changes + [Change(metric, "new") for metric in after if metric not in before]


def judge(before: Row, after: Row, slack: float) -> Change:
    """One metric: by its ratio where both sides have the same peer, else by its value."""
    if before.unit != after.unit or before.better != after.better:
        return Change(before.metric, "not comparable", compared=f"{before.unit} and {after.unit}")
    if before.ratio is not None and after.ratio is not None and before.peer == after.peer:
        a, b, compared = before.ratio, after.ratio, f"x {after.peer}"
    elif before.machine == after.machine:
        a, b, compared = before.value, after.value, after.unit
    else:
        return Change(before.metric, "not comparable", before.value, after.value, f"{after.unit}, another machine")
    told = verdict(a, b, after.better == "lower", slack * before.tolerance)
    return Change(before.metric, told, a, b, compared)


def verdict(before: float, after: float, lower_is_better: bool, tolerance: float) -> Verdict:
    """Whether a number moved by more than a share of what it was; what is no longer finite is worse."""
    if not math.isfinite(before):
        return "better" if math.isfinite(after) else "same"
    if not math.isfinite(after):
        return "worse"
    gain = (before - after) if lower_is_better else (after - before)
    if abs(gain) <= tolerance * abs(before):
        return "same"
    return "better" if gain > 0 else "worse"


if __name__ == "__main__":
    sys.exit(main())
