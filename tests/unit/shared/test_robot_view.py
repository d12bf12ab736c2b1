# SPDX-License-Identifier: Apache-2.0
"""A robot's row in the fleet from the messages that came: lost, late, doubled, of an earlier life."""

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import topics
from shared.codec import Envelope
from shared.geometry import Pose2
from shared.messages import BaseStatus, GuardState, GuardStatus, NavState, NavStatus
from shared.robot_view import MAX_BEHIND, SILENT_S, RobotView

MS = 1_000_000


def status(state: NavState = NavState.NAVIGATING) -> NavStatus:
    return NavStatus(0, 1, state, "", "", "", Pose2(), 2.5, 1.0, 0, 1, 0)


def envelope(sequence: int, session: str = "a", sent: int | None = None) -> Envelope:
    return Envelope("navigator", session, sequence, sequence if sent is None else sent)


def heard(sequences: list[int], session: str = "a", view: RobotView | None = None) -> RobotView:
    view = view or RobotView("red", "0")
    for sequence in sequences:
        sent = sequence * 200 * MS
        view.add(topics.NAV_STATUS, status(), envelope(sequence, session, sent), 10.0, sent + 7 * MS)
    return view


@given(
    st.integers(2, 60).flatmap(
        lambda n: st.tuples(st.just(n), st.sets(st.integers(1, n - 2) if n > 2 else st.nothing()))
    )
)
def test_the_share_that_arrived_is_that_of_the_messages_between_first_and_last(drawn):
    n, lost = drawn
    kept = [i for i in range(n) if i not in lost]
    row = heard(kept).row(10.0)
    assert row.received == (n - 1 - len(lost)) / (n - 1)
    assert row.delay == 0.007


@given(st.permutations(range(12)))
def test_order_and_doubles_change_nothing(order):
    assert heard([*order, *order]).row(10.0) == heard(list(range(12))).row(10.0)


def test_of_a_robot_that_runs_for_long_as_much_is_kept_as_of_another():
    view = RobotView("red", "0")
    for begin in range(0, 20 * MAX_BEHIND, 4):
        heard([begin, begin + 2, begin + 1], view=view)  # every fourth is lost
    heard([0, 20 * MAX_BEHIND - 4], view=view)  # doubles
    n, last = 15 * MAX_BEHIND, 20 * MAX_BEHIND - 2
    assert view.row(10.0).received == (n - 1) / last
    assert len(pickle.dumps(view)) < 20 * MAX_BEHIND


def test_a_navigator_that_was_started_again_counts_from_there_on():
    view = heard([100, 101, 103], "a")
    assert heard([0, 1, 2, 3], "b", view).row(10.0).received == 1.0


def test_stop_comes_before_the_task_and_silence_before_both():
    view = heard([0, 1])
    assert (view.row(10.0).state, view.row(10.0).task) == ("navigating", "2.5 m left")
    stopped = GuardStatus(0, GuardState.STOPPED, "", "estop", "", 0.0)
    view.add(topics.GUARD, stopped, Envelope("guard", "g", 0, 0), 10.0, 0)
    row = view.row(10.0)
    assert row.state == "stopped"
    assert row.reason
    assert (view.row(10.1 + SILENT_S).state, view.row(10.1 + SILENT_S).reason) == ("silent", "")


def test_an_older_message_that_comes_later_is_not_shown():
    view = RobotView("red", "0")
    for sent in (2, 4, 1, 3):
        message = BaseStatus(sent, 20.0 + sent, 0.0, 0.0, True, "", "")
        view.add(topics.BASE_STATUS, message, Envelope("base_driver", "b", sent, sent), 0.0, 0)
    assert view.row(0.0).battery == 24.0


@pytest.mark.parametrize(("session", "sequence", "pause"), [("a", 2, 0.2), ("b", 0, SILENT_S + 0.1)])
def test_a_robot_whose_clock_is_set_back_is_shown_as_it_is(session, sequence, pause):
    """By itself, or with a restart."""
    view, now = heard([0, 1]), 3600 * 1000 * MS
    view.add(topics.NAV_STATUS, status(), envelope(2 if session == "b" else 1, sent=now), 10.0, now)
    view.add(topics.NAV_STATUS, status(NavState.REACHED), envelope(sequence, session, 0), 10.0 + pause, now)
    assert view.row(10.0 + pause).state == "reached"


def test_a_late_message_of_an_earlier_life_is_not_shown():
    view = heard([100], "b")
    now = 100 * 200 * MS
    view.add(topics.NAV_STATUS, status(NavState.REACHED), envelope(7, "a", now - 1), 10.1, now)
    assert view.row(10.1).state == "navigating"


def test_a_battery_that_was_not_measured_is_unknown():
    view = RobotView("red", "0")
    unmeasured = BaseStatus(0, float("nan"), 0.0, 0.0, True, "", "")
    view.add(topics.BASE_STATUS, unmeasured, Envelope("base_driver", "b", 0, 0), 0.0, 0)
    assert view.row(0.0).battery is None
