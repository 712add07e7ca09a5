"""What holds for every test."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def torch_runs_in_one_thread() -> None:
    """Tensors here are small, and threads of torch that wait for each other on a busy machine cost ten times the work.

    A test of the number of threads sets it itself. torch is not imported for this: the core runs without it.
    """
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)


@pytest.fixture(scope="session")
def house_photos(tmp_path_factory) -> Path:
    """Six photos, 320 x 240, of which every mapper makes one model. Copy them before changing them."""
    import numpy as np

    from fieldstone.synthetic.photos import PhotoOptions, make_photos, write_photos

    options = PhotoOptions(num_photos=6, width=320, height=240, arc_deg=60.0, samples_per_axis=1, texel=0.03)
    folder = tmp_path_factory.mktemp("house")
    write_photos(make_photos(options, np.random.default_rng(0)), folder, options)
    for path in folder.iterdir():
        if path.suffix != ".jpg":
            path.unlink()
    return folder
