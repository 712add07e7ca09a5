"""What holds for every test."""

from __future__ import annotations

import sys

import pytest


@pytest.fixture(scope="session", autouse=True)
def torch_runs_in_one_thread() -> None:
    """Tensors here are small, and threads of torch that wait for each other on a busy machine cost ten times the work.

    A test of the number of threads sets it itself. torch is not imported for this: the core runs without it.
    """
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
