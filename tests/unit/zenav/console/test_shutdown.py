# SPDX-License-Identifier: Apache-2.0
import os
import signal
import sys
import threading

import pytest

from zenav.console.shutdown import StopFlag, stop_on_signal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_wait_and_the_handlers_of_before_come_back(number):
    before = signal.getsignal(number)
    with stop_on_signal() as stop:
        killer = threading.Timer(0.05, os.kill, (os.getpid(), number))
        killer.start()
        assert stop.wait(50)
        killer.join()
        assert stop.is_set()
        assert stop.wait(50)  # from now on at once
    assert signal.getsignal(number) is before


def test_a_hangup_that_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.is_set()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_wait_without_a_signal_ends_unset():
    assert not StopFlag().wait(0.01)


@pytest.mark.parametrize("seconds", [float("inf"), 1e15])
def test_a_wait_of_any_length_ends_when_it_is_set(seconds):
    stop = StopFlag()
    setter = threading.Timer(0.05, stop.set)
    setter.start()
    assert stop.wait(seconds)
    setter.join()


def interrupted_at(stop, line):
    """What `stop.wait` returns when a handler that sets it runs before the line-th line of it; None: no such line.

    A tracer stands for the handler: both run between two lines of any Python function, on its thread.
    """
    n_lines = 0

    def interrupt(frame, event, argument):
        nonlocal n_lines
        if event == "line":
            n_lines += 1
            if n_lines == line:
                stop.set()
        return interrupt

    before = sys.gettrace()
    sys.settrace(interrupt)
    try:
        reached = stop.wait(0.01)
    finally:
        sys.settrace(before)
    return reached if n_lines >= line else None


@pytest.mark.timeout(20)
def test_a_handler_may_set_it_wherever_it_interrupts_the_wait():
    line = 1
    while (reached := interrupted_at(StopFlag(), line)) is not None:
        assert reached
        line += 1
    assert line > 2
