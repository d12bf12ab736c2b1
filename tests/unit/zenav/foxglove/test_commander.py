# SPDX-License-Identifier: Apache-2.0
"""One drives, while it sends; then the robot stands, then others may."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zenav.foxglove.commander import COMMAND_HOLD_S, STANDS, TeleopArbiter
from zenav.foxglove.inbound import InvalidMessageError

BRIEFLY = 0.01  # s


def test_a_command_counts_until_it_is_too_old_then_zero_then_nothing():
    commander = TeleopArbiter()
    assert commander.command(0.0) is None
    commander.request(1, 0.3, -0.1, 10.0)
    assert commander.command(10.0 + COMMAND_HOLD_S - BRIEFLY) == (0.3, -0.1)
    assert commander.command(10.0 + COMMAND_HOLD_S + BRIEFLY) == (0.0, 0.0)
    assert commander.command(10.0 + COMMAND_HOLD_S + STANDS) == (0.0, 0.0)
    assert commander.command(10.0 + COMMAND_HOLD_S + STANDS + 2 * BRIEFLY) is None


def test_who_is_gone_drives_no_more():
    commander = TeleopArbiter()
    commander.request(1, 0.3, 0.0, 10.0)
    commander.remove_client(2, 10.1)
    assert commander.command(10.1) == (0.3, 0.0)
    commander.remove_client(1, 10.1)
    assert commander.command(10.1) == (0.0, 0.0)
    commander.request(2, 0.1, 0.0, 10.2)
    assert commander.command(10.2) == (0.1, 0.0)


def test_somebody_elsewhere_has_the_robot_and_nothing_is_said_against_it():
    commander = TeleopArbiter()
    commander.request(1, 0.3, 0.0, 9.9)
    commander.on_other_command(10.0)
    assert commander.command(10.0) is None
    with pytest.raises(InvalidMessageError, match="elsewhere"):
        commander.request(1, 0.3, 0.0, 10.0 + COMMAND_HOLD_S - BRIEFLY)
    assert commander.command(10.0 + COMMAND_HOLD_S - BRIEFLY) is None
    commander.request(1, 0.3, 0.0, 10.0 + COMMAND_HOLD_S + BRIEFLY)
    assert commander.command(10.0 + COMMAND_HOLD_S + BRIEFLY) == (0.3, 0.0)


events = st.lists(st.tuples(st.integers(1, 3), st.sampled_from(["take", "gone", "look"]), st.floats(0, 1)), max_size=40)


@given(events)
def test_what_goes_out_is_always_one_clients_young_command_or_zero(events):
    commander, at = TeleopArbiter(), 0.0
    sent: dict[int, tuple[float, float]] = {}  # by client: velocity and time of its last accepted command
    for client, what, later in events:
        at += later
        if what == "take":
            rivals = [c for c, (_, then) in sent.items() if c != client and at - then <= COMMAND_HOLD_S]
            try:
                commander.request(client, float(client), 0.0, at)
                assert not rivals
                sent[client] = float(client), at
            except InvalidMessageError:
                assert len(rivals) == 1
        elif what == "gone":
            commander.remove_client(client, at)
            sent.pop(client, None)
        command = commander.command(at)
        young = [v for v, then in sent.values() if at - then <= COMMAND_HOLD_S]
        assert command == (young[0], 0.0) if young else command in ((0.0, 0.0), None)
