# SPDX-License-Identifier: Apache-2.0
import pytest

from services.base_driver.watchdog import Watchdog, WatchdogConfig
from shared.messages import Velocity
from shared.stamps import FUTURE

MS = 1_000_000


def command(ms, v=0.3, w=0.0):
    return Velocity(ms * MS, v, w, "")


def running(*stamps):
    watchdog = Watchdog(WatchdogConfig())
    for ms in stamps:
        assert watchdog.offer(command(ms), ms * MS)
    return watchdog


@pytest.mark.parametrize(("later", "v"), [(0, 0.3), (200, 0.3), (200.001, 0.0), (-0.001, 0.0)])
def test_a_command_acts_for_its_age_and_not_before(later, v):
    assert running(1000).velocity(round((1000 + later) * MS)) == (v, 0.0)


def test_the_age_of_refused_commands_is_told():
    watchdog = running()
    assert not watchdog.offer(command(1000), 3500 * MS)
    assert watchdog.refused == "commands are refused: 2.5 s old"
    assert not watchdog.offer(command(4000), 3500 * MS)
    assert watchdog.refused == "commands are refused: 0.5 s ahead of this clock"
    assert watchdog.offer(command(3500), 3500 * MS)
    assert watchdog.refused == ""


@pytest.mark.parametrize(("silence", "armed"), [(499, False), (500, True), (501, True)])
def test_after_disarming_a_silence_since_then_arms(silence, armed):
    watchdog = running(1000)
    watchdog.disarm(2000 * MS)
    assert watchdog.offer(command(2000 + silence), (2000 + silence) * MS)
    assert watchdog.armed is armed
    assert (watchdog.velocity((2000 + silence) * MS) != (0, 0)) is armed


@pytest.mark.parametrize(("v", "w", "armed"), [(0.0, 0.0, True), (0.1, 0.0, False), (0.0, 0.1, False)])
def test_after_disarming_zero_arms(v, w, armed):
    watchdog = running(1000)
    watchdog.disarm(1010 * MS)
    watchdog.offer(command(1050, v, w), 1050 * MS)
    assert watchdog.armed is armed


def test_disarming_ends_the_present_command():
    watchdog = running(1000)
    watchdog.disarm(1010 * MS)
    assert watchdog.velocity(1010 * MS) == (0, 0)


@pytest.mark.parametrize(("back_by", "taken"), [(FUTURE, False), (FUTURE + 1, True)])
def test_only_a_clock_set_back_by_more_than_the_skew_makes_older_commands_count(back_by, taken):
    watchdog = running(5000)
    now = 5000 * MS - back_by
    assert watchdog.offer(Velocity(now, 0.2, 0.0, ""), now) is taken


def test_a_clock_set_back_after_disarming_does_not_silence_for_ever():
    watchdog = Watchdog(WatchdogConfig())
    watchdog.disarm(60_000 * MS)
    assert watchdog.offer(command(1000), 1000 * MS)
    assert not watchdog.armed, "a stream that ran all the time moves the robot"
    assert watchdog.offer(command(1500), 1500 * MS)
    assert watchdog.armed
