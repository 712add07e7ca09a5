"""Ctrl-C as the system sends it, in the middle of a step."""

import os
import signal
import threading

import numpy as np
import pytest

from fieldstone.field.base.budget import Budget
from fieldstone.field.base.interrupts import deferred_interrupts
from fieldstone.field.base.radiance_field import StepReport
from fieldstone.field.base.training import train


def press():
    os.kill(os.getpid(), signal.SIGINT)


class TwoHalves:
    """A training that moves two numbers in place, and is interrupted between them in step 3."""

    def start(self):
        raise NotImplementedError

    to_tensors = from_tensors = renderer = lambda self, state, /: state

    def advance(self, state, /):
        state = (state[0] + 1, state[1])
        state[1][0] += 1
        if state[0] == 3:
            press()
        state[1][1] += 1
        return state, StepReport(0.1, 0.1)


def test_a_step_is_finished_before_its_checkpoint_is_written():
    saved = []
    with pytest.raises(KeyboardInterrupt):
        train(
            TwoHalves(),
            (0, np.zeros(2)),
            budget=Budget.start(None),
            max_steps=9,
            save=lambda state, curve: saved.append((state[0], *state[1], len(curve))),
        )
    assert saved == [(3, 3.0, 3.0, 3)]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_nobody_asked_for_is_raised_at_the_end():
    done = []

    def work():
        with deferred_interrupts():
            press()
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == [True]


def test_an_outer_block_hears_what_comes_after_an_inner_one():
    done = []

    def work():
        with deferred_interrupts() as check:
            with deferred_interrupts():
                done.append("inner")
            press()
            done.append("pressed")
            check()
            done.append("not reached")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["inner", "pressed"]


def test_other_threads_hear_nothing():
    heard = []

    def work():
        with deferred_interrupts() as check:
            check()
            heard.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert heard == [signal.default_int_handler]


def test_the_state_shown_now_and_then_is_that_after_a_step():
    shown = []
    train(
        TwoHalves(),
        (3, np.zeros(2)),
        budget=Budget.start(None),
        max_steps=4,
        show=lambda state: shown.append((state[0], *state[1])),
        show_every_s=0.0,
    )
    assert shown == [(4, 1.0, 1.0), (5, 2.0, 2.0), (6, 3.0, 3.0), (7, 4.0, 4.0)]
