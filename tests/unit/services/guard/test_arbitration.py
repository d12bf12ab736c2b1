# SPDX-License-Identifier: Apache-2.0
import pytest

from services.guard.arbitration import ArbitrationConfig, CommandSource, active_source
from shared.messages import Velocity

MS = 1_000_000
NOW = 10_000 * MS
CONFIG = ArbitrationConfig()


def source(*stamps_ms, name="nav", v=0.3):
    made = CommandSource(name, CONFIG)
    for stamp in stamps_ms:
        made.accept(Velocity(stamp * MS, v, 0.0, ""), stamp * MS)
    return made


def command(ms, v=0.3, w=0.0):
    return Velocity(ms * MS, v, w, "")


def test_commands_are_taken_in_the_order_of_their_stamps():
    nav = source(1000)
    assert not nav.accept(command(1000, 0.5), 1010 * MS)
    assert not nav.accept(command(990, 0.5), 1010 * MS)
    assert nav.accept(command(1001, 0.4), 1010 * MS)
    assert nav.command.v == 0.4


@pytest.mark.parametrize(("age", "taken"), [(200, True), (201, False), (-100, True), (-101, False)])
def test_old_and_future_commands_are_not_taken(age, taken):
    assert source().accept(command(5000 - age), 5000 * MS) is taken


def test_after_the_clock_was_set_back_commands_count():
    nav = source(60_000)
    nav.disarm(60_000 * MS)
    assert nav.accept(command(100), 100 * MS)
    assert not nav.is_armed, "a stream that ran all the time moves the robot"
    assert nav.accept(command(700), 700 * MS)
    assert nav.is_armed


@pytest.mark.parametrize("ahead", [0, 1, 99])
def test_a_command_from_a_clock_that_is_ahead_ends_no_later(ahead):
    nav = source()
    assert nav.accept(command(1000 + ahead), 1000 * MS)
    assert nav.is_newer_than(0.2, 1200 * MS)
    assert not nav.is_newer_than(0.2, 1201 * MS)


@pytest.mark.parametrize(
    ("teleop_age", "nav_age", "expected"),
    [(0, 0, "teleop"), (499, 0, "teleop"), (501, 0, "nav"), (0, None, "teleop"), (None, 0, "nav"), (None, None, "nav")],
)
def test_teleop_goes_before_nav_while_it_speaks(teleop_age, nav_age, expected):
    teleop = source(*([] if teleop_age is None else [10_000 - teleop_age]), name="teleop")
    nav = source(*([] if nav_age is None else [10_000 - nav_age]))
    assert active_source(teleop, nav, NOW).name == expected


def test_a_source_counts_from_the_start():
    assert source(1000).is_armed
    assert source(1000).wants_motion
    assert not source(1000, v=0.0).wants_motion
    assert not source().wants_motion


@pytest.mark.parametrize(("v", "w", "armed"), [(0.0, 0.0, True), (0.1, 0.0, False), (0.0, 0.1, False)])
def test_after_a_release_only_zero_arms_a_running_stream(v, w, armed):
    nav = source(1000, 1050)
    nav.disarm(1060 * MS)
    for stamp in range(1100, 3000, 50):
        nav.accept(command(stamp), stamp * MS)
    assert not nav.is_armed
    nav.accept(command(3000, v, w), 3000 * MS)
    assert nav.is_armed is armed


@pytest.mark.parametrize(("silence", "armed"), [(499, False), (500, True)])
def test_after_a_release_a_silence_since_then_arms(silence, armed):
    nav = source(1000)
    nav.disarm(5000 * MS)
    nav.accept(command(5000 + silence), (5000 + silence) * MS)
    assert nav.is_armed is armed


def test_a_silence_between_two_commands_after_the_release_arms():
    nav = source(1000)
    nav.disarm(1000 * MS)
    nav.accept(command(1100), 1100 * MS)
    assert not nav.is_armed
    nav.accept(command(1600), 1600 * MS)
    assert nav.is_armed
