"""Where public photos lie for benchmarks: never part of the project, because their licences differ."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path

DATA = Path(os.environ.get("FIELDSTONE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def present(paths: Iterable[Path]) -> list[Path]:
    """Those paths that exist; the others are skipped with a printed reason."""
    found = []
    for path in paths:
        if path.exists():
            found.append(path)
        else:
            sys.stdout.write(f"skipped: nothing at {path}; set FIELDSTONE_DATA to the folder that holds {path.name}\n")
    return found
