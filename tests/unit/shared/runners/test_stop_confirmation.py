# SPDX-License-Identifier: Apache-2.0
"""STOP and its release: only what the guard says after the order confirms it."""

from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import pytest

from shared.config import UserError
from shared.messages import GuardState, GuardStatus
from shared.runners import stop_confirmation
from shared.runners.stop_confirmation import confirm_stop
from shared.types import NS_PER_S


class FakeClient:
    """A client that hears a status of the guard after each order; before the first there is an old one."""

    def __init__(self, before, after):
        self.heard, self.after, self.n_orders, self.arrived = before, list(after), 0, 0.0
        self.stamps, self._clock = [], count()

    def now(self):
        return next(self._clock)

    def publish(self, publication):
        self.n_orders += 1
        self.stamps.append(publication.message.stamp)

    def age(self, topic):
        return 0.5 if not self.arrived else 0.0

    def wait(self, topic, holds, timeout):
        if holds(self.heard):
            return self.heard
        if self.after:
            self.heard, self.arrived = self.after.pop(0), 1.0
        return self.heard if holds(self.heard) else None

    def latest(self, topic):
        return self.heard


def status(state, reason):
    return GuardStatus(0, state, "", reason, "", 0.0)


STUCK = status(GuardState.FAULT, "wheel_stuck")
STOPPED = status(GuardState.STOPPED, "estop")
IDLE = status(GuardState.IDLE, "no_command")
HELD = status(GuardState.HOLD, "estop_released")


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(stop_confirmation, "PATIENCE_S", 0.2)


def test_the_release_of_a_fault_is_repeated_until_the_fault_has_ended():
    client = FakeClient(STUCK, [STUCK, STUCK, HELD])
    confirm_stop(client, False, "test")
    assert client.n_orders == 3
    assert len(set(client.stamps)) == 1, "a STOP that was pressed meanwhile is newer, and holds"


def test_a_release_counts_by_the_guard_s_clock_where_that_is_ahead():
    client = FakeClient(replace(STOPPED, stamp=10**15), [HELD])
    confirm_stop(client, False, "test")
    assert 10**15 - NS_PER_S < min(client.stamps) <= 10**15


def test_a_stop_that_is_pressed_while_the_release_waits_for_a_status_holds(monkeypatch):
    clock = count()
    monkeypatch.setattr(stop_confirmation, "time", SimpleNamespace(monotonic=lambda: next(clock) / 10))
    pressed_at = 10**7  # ns after the call, and before the first status, which comes 0.1 s after it
    client = FakeClient(replace(STOPPED, stamp=10**8), [HELD])
    confirm_stop(client, False, "test")
    assert max(client.stamps) < pressed_at


def test_a_repeated_stop_has_a_new_stamp_each_time():
    client = FakeClient(IDLE, [IDLE, IDLE, STOPPED])
    confirm_stop(client, True, "test")
    assert len(set(client.stamps)) == client.n_orders == 3


@pytest.mark.parametrize(("press", "before"), [(True, STOPPED), (False, IDLE)])
def test_a_status_from_before_the_order_confirms_nothing(press, before):
    client = FakeClient(before, [STOPPED if press else IDLE])
    confirm_stop(client, press, "test")
    assert not client.after


def test_a_fault_that_stays_is_told_with_its_reason():
    with pytest.raises(UserError, match="a wheel is commanded but does not turn"):
        confirm_stop(FakeClient(STUCK, [STUCK]), False, "test")
