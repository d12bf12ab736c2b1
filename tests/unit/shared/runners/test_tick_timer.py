# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from shared.runners.tick_timer import TickTimer

MS = 1_000_000


def ticks(timer: TickTimer, messages: list[int], until: int, key: str = "scan") -> list[int]:
    """When it ticks, ms, given when messages are taken, ms."""
    now, found, waiting = 0, [], sorted(messages)
    while now < until * MS:
        if waiting and waiting[0] * MS <= timer.due:
            now = max(now, waiting.pop(0) * MS)
            timer.follow(key, now)
        else:
            now = max(now, timer.due)
            timer.advance(now)
            found.append(now // MS)
    return found


def test_without_a_topic_the_grid_is_fixed():
    assert ticks(TickTimer(20, "", 0), [7, 33, 60], 200) == [0, 50, 100, 150, 200]


def test_it_comes_into_step_with_a_topic_from_any_phase_and_keeps_its_rate():
    for phase in range(100):
        found = ticks(TickTimer(20, "scan", 0), list(range(phase, 2000, 100)), 1990)
        late = [t for t in found if 300 < t < 1900]
        assert {(t - phase) % 100 for t in late} == {0, 50}


def test_messages_that_jitter_by_less_than_the_slack_are_never_kept_waiting():
    messages = [100 * n + (4 if n % 2 else -4) for n in range(1, 20)]
    found = ticks(TickTimer(20, "scan", 0), messages, 1900)
    assert set(messages[3:-1]) <= set(found)


def test_without_messages_it_goes_on_at_its_period():
    found = ticks(TickTimer(20, "scan", 0), [100, 200, 300], 700)
    gaps = [b - a for a, b in pairwise(found)]
    assert max(gaps) <= 60
    assert gaps[-3:] == [50, 50, 50]


def test_faster_topics_do_not_make_it_faster():
    assert ticks(TickTimer(20, "scan", 0), list(range(0, 1000, 25)), 300) == [0, 50, 100, 150, 200, 250]


@given(st.lists(st.integers(0, 3000), max_size=80))
def test_two_ticks_are_never_much_closer_than_half_a_period_nor_farther_than_one_and_the_slack(messages):
    found = ticks(TickTimer(20, "scan", 0), messages, 3000)
    gaps = [b - a for a, b in pairwise(found)]
    assert all(22 <= gap <= 60 for gap in gaps)


def test_missed_ticks_are_skipped_and_a_clock_that_jumps_back_is_followed():
    timer = TickTimer(20, "", 0)
    timer.advance(0)
    timer.advance(320 * MS)
    assert timer.due == 350 * MS
    assert not timer.is_due(340 * MS)
    assert timer.is_due(-1000 * MS)
    timer.advance(-1000 * MS)
    assert -1000 * MS < timer.due <= -950 * MS
