# SPDX-License-Identifier: Apache-2.0
"""The app's refusal to a second client is a message that the app can show."""

import pytest

from zenav.foxglove.commander import COMMAND_HOLD_S, Commander
from zenav.foxglove.inbound import InvalidMessageError


def test_a_second_client_is_refused_until_the_first_is_silent():
    commander = Commander()
    commander.request(1, 0.3, 0.0, 10.0)
    with pytest.raises(InvalidMessageError, match="client 1 drives"):
        commander.request(2, -0.3, 0.0, 10.0 + COMMAND_HOLD_S)
    assert (commander.driver, commander.command(10.0 + COMMAND_HOLD_S)) == (1, (0.3, 0.0))
    commander.request(2, -0.3, 0.0, 10.01 + COMMAND_HOLD_S)
    assert (commander.driver, commander.command(10.01 + COMMAND_HOLD_S)) == (2, (-0.3, 0.0))


def test_another_tool_has_the_robot_at_once():
    commander = Commander()
    commander.request(1, 0.3, 0.0, 10.0)
    commander.on_other_command(10.1)
    assert commander.command(10.1) is None
    with pytest.raises(InvalidMessageError, match="elsewhere"):
        commander.request(1, 0.3, 0.0, 10.2)


def test_a_client_that_left_drives_no_more():
    commander = Commander()
    commander.request(1, 0.3, 0.0, 10.0)
    commander.remove_client(1, 10.1)
    assert (commander.driver, commander.command(10.1)) == (None, (0.0, 0.0))
