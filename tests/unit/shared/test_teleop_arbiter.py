# SPDX-License-Identifier: Apache-2.0
"""One client drives, while it sends; then the robot stands, then others may drive."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.teleop_arbiter import OTHER_HOLD_S, STANDING_S, TeleopArbiter, TeleopRefusedError

HOLD = 0.2  # s
BRIEFLY = 0.01  # s


@pytest.fixture
def arbiter() -> TeleopArbiter:
    return TeleopArbiter(HOLD)


def test_a_command_counts_until_it_is_too_old_then_zero_then_nothing(arbiter):
    assert arbiter.command(0.0) is None
    arbiter.request(1, "page 1", 0.3, -0.1, 10.0)
    assert arbiter.command(10.0 + HOLD - BRIEFLY) == (0.3, -0.1)
    assert arbiter.command(10.0 + HOLD + BRIEFLY) == (0.0, 0.0)
    assert arbiter.command(10.0 + HOLD + STANDING_S) == (0.0, 0.0)
    assert arbiter.command(10.0 + HOLD + STANDING_S + 2 * BRIEFLY) is None


def test_a_client_that_is_gone_drives_no_more(arbiter):
    arbiter.request(1, "page 1", 0.3, 0.0, 10.0)
    arbiter.remove_client(2, 10.1)
    assert arbiter.command(10.1) == (0.3, 0.0)
    arbiter.remove_client(1, 10.1)
    assert arbiter.command(10.1) == (0.0, 0.0)
    arbiter.request(2, "page 2", 0.1, 0.0, 10.2)
    assert arbiter.command(10.2) == (0.1, 0.0)


def test_a_second_driver_is_refused_with_the_name_of_the_first(arbiter):
    arbiter.request(1, "the tablet", 0.3, 0.0, 10.0)
    with pytest.raises(TeleopRefusedError, match="the tablet drives"):
        arbiter.request(2, "page 2", -0.3, 0.0, 10.1)
    assert arbiter.command(10.1) == (0.3, 0.0)


def test_another_tool_has_the_robot_and_nothing_is_published_against_it(arbiter):
    arbiter.request(1, "page 1", 0.3, 0.0, 9.9)
    arbiter.on_other_command(10.0)
    assert arbiter.command(10.0) is None
    with pytest.raises(TeleopRefusedError, match="elsewhere"):
        arbiter.request(1, "page 1", 0.3, 0.0, 10.0 + OTHER_HOLD_S - BRIEFLY)
    assert arbiter.command(10.0 + OTHER_HOLD_S - BRIEFLY) is None
    arbiter.request(1, "page 1", 0.3, 0.0, 10.0 + OTHER_HOLD_S + BRIEFLY)
    assert arbiter.command(10.0 + OTHER_HOLD_S + BRIEFLY) == (0.3, 0.0)


def test_a_clock_that_is_set_back_ends_the_drive(arbiter):
    arbiter.request(1, "page 1", 0.3, 0.0, 1000.0)
    assert arbiter.command(10.0) == (0.0, 0.0)
    assert arbiter.driver is None


events = st.lists(st.tuples(st.integers(1, 3), st.sampled_from(["take", "gone", "look"]), st.floats(0, 1)), max_size=40)


@given(events)
def test_what_goes_out_is_always_one_clients_recent_command_or_zero(events):
    arbiter, at = TeleopArbiter(HOLD), 0.0
    sent: dict[int, tuple[float, float]] = {}  # by client: velocity and time of its last accepted command
    for client, what, later in events:
        at += later
        if what == "take":
            rivals = [c for c, (_, then) in sent.items() if c != client and at - then <= HOLD]
            try:
                arbiter.request(client, f"page {client}", float(client), 0.0, at)
                assert not rivals
                sent[client] = float(client), at
            except TeleopRefusedError:
                assert len(rivals) == 1
        elif what == "gone":
            arbiter.remove_client(client, at)
            sent.pop(client, None)
        command = arbiter.command(at)
        recent = [v for v, then in sent.values() if at - then <= HOLD]
        assert command == (recent[0], 0.0) if recent else command in ((0.0, 0.0), None)
