"""What a benchmark measured, as rows that can be kept and compared.

A row is one number: of ours, and of the peer that was measured in the same run where there is one. On another machine,
or the same one with other work on it, the ratio of the two is what can be compared; see `benchmarks.compare`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

Better = Literal["lower", "higher"]
"""Which way a metric improves."""

TIMES, QUALITY = 0.15, 0.02
"""How much a time scatters on a busy machine, and a number that only another choice of order or seed moves."""

ROOT = Path(__file__).resolve().parents[1]
NEW_ROWS = ROOT / "out" / "benchmarks"
"""Where rows go; those of `benchmarks/results` are the baseline, and change in a commit that says why."""


@dataclass(frozen=True)
class Row:
    """One measured number."""

    metric: str
    """What was measured and on what, parts joined by "/": "bundle/ring200/cpu". Unique within a file."""
    value: float
    unit: str
    better: Better
    tolerance: float = TIMES
    """Share by which it may get worse before that counts."""
    peer: str | None = None
    """What else did the same work in the same run."""
    peer_value: float | None = None
    commit: str = ""
    machine: str = ""

    def __post_init__(self) -> None:
        if self.better not in ("lower", "higher"):
            raise ValueError(f"better must be lower or higher, got {self.better!r}")
        if not self.tolerance >= 0:
            raise ValueError(f"{self.metric}: a tolerance is a share of at least 0, got {self.tolerance}")
        if (self.peer is None) != (self.peer_value is None):
            raise ValueError(f"{self.metric}: a peer needs a value and a value a peer, got {self.peer!r}")

    @property
    def ratio(self) -> float | None:
        """Ours over the peer's; None without a peer, or where the peer's number is zero."""
        return self.value / self.peer_value if self.peer_value else None


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write rows as a JSON list, with their ratios, the commit and the machine.

    Raises:
        ValueError: two rows have one metric.
    """
    names = [row.metric for row in rows]
    if len(set(names)) < len(names):
        raise ValueError(f"measured twice: {sorted({name for name in names if names.count(name) > 1})}")
    here = {"commit": commit(), "machine": machine()}
    documents = [asdict(row) | {"ratio": row.ratio} | here for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("[\n" + ",\n".join("  " + json.dumps(document) for document in documents) + "\n]\n")


def read_rows(path: Path) -> list[Row]:
    """Read the rows of a file, or those of every `*.json` in a folder.

    Raises:
        ValueError: a file is not a list of rows.
    """
    paths = sorted(path.glob("*.json")) if path.is_dir() else [path]
    return [row for each in paths for row in _rows_of(each)]


def add_out_option(parser: argparse.ArgumentParser, name: str) -> None:
    """Give a benchmark the option --out, a file for its rows; the default is `out/benchmarks/NAME.json`."""
    parser.add_argument("--out", type=Path, default=NEW_ROWS / f"{name}.json", help="file for the rows (JSON)")


def commit() -> str:
    """The commit of the tree, with "+" where files differ from it; empty outside of a repository."""
    try:
        told = subprocess.run(
            ["git", "describe", "--always", "--exclude=*", "--dirty=+"],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return ""
    return told.stdout.strip()


def machine() -> str:
    """Processor, the cores that this process may use, and the Python."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{_processor()}, {cores} cores, Python {platform.python_version()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.machine())


def _rows_of(path: Path) -> Iterable[Row]:
    known = {field.name for field in fields(Row)}
    try:
        documents = json.loads(path.read_text())
        return [Row(**{name: document[name] for name in known & document.keys()}) for document in documents]
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} holds no rows: {error}") from error
