"""Where the real test photos lie: never part of the project, because their licences differ."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data_folder(name: str) -> Path:
    """Folder of one data set; the test is skipped, with the reason, where it is absent."""
    root = Path(os.environ.get("FIELDSTONE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    folder = root / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: set FIELDSTONE_DATA to the folder that holds {name}")
    return folder
