"""One clock for the time that a run may take."""

import math

import pytest

from fieldstone.field.base import budget as module
from fieldstone.field.base.budget import Budget


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets."""
    now = [100.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    return now


def test_what_is_spent_and_left_add_up(clock):
    budget = Budget.start(8.0)
    clock[0] += 3.0
    assert (budget.spent(), budget.left()) == (3.0, 5.0)
    clock[0] += 6.0
    assert budget.left() == -1.0
    assert budget.is_limited


def test_a_part_runs_on_the_same_clock(clock):
    budget = Budget.start(8.0)
    clock[0] += 2.0
    assert budget.part(0.75).left() == pytest.approx(4.0)


def test_no_limit_is_never_over(clock):
    budget = Budget.start(None)
    clock[0] += 1e9
    assert budget.left() == math.inf
    assert not budget.is_limited
