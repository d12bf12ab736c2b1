# SPDX-License-Identifier: Apache-2.0
"""The Python API against toy services over Zenoh: a task's end, a refusal, STOP, the map as an array."""

from collections.abc import Iterator

import pytest

from shared import topics
from shared.config import UserError
from shared.messages import NavState, NavStatus
from tests.stack.test_client import ReachingNavigator, StopGuard, TileMapper
from tests.stack.test_live import running
from zenav.client import RobotConnection, connect
from zenav.stack.launch import free_stack


@pytest.fixture(scope="module")
def robot() -> Iterator[RobotConnection]:
    toys = ReachingNavigator(), StopGuard(), TileMapper()
    with (
        free_stack() as claim,
        running(toys[0], "navigator", claim.where),
        running(toys[1], "guard", claim.where),
        running(toys[2], "mapper", claim.where),
        connect(stack=str(claim.where.domain)) as connected,
    ):
        yield connected


def test_a_task_returns_when_it_has_ended_and_its_status_is_called_back(robot):
    heard: list[NavStatus] = []
    robot.on_status(heard.append)
    first = robot.goto(1, 2)
    assert first.good
    assert robot.route([(1, 2, 90), (2, 2, 0)], loops=2).good
    assert robot.explore().good
    assert {NavState.NAVIGATING, NavState.EXPLORING, NavState.REACHED} <= {status.state for status in heard}
    assert robot.status().task_id == 3


def test_a_refusal_and_a_wrong_argument_are_errors_with_hints(robot):
    with pytest.raises(UserError, match="outside the map") as refused:
        robot.goto(101, 0)
    assert refused.value.hint
    with pytest.raises(UserError, match="some poses have a heading"):
        robot.route([(1, 2, 90), (2, 2, None)])


def test_stop_is_confirmed_and_the_map_is_an_array(robot):
    robot.estop()
    robot.estop(press=False)
    grid = robot.map()
    assert (grid.cells.dtype, grid.resolution) == ("int8", 0.05)
    assert grid.cells.shape == (3 * 64, 3 * 64)
    assert (grid.x, grid.y) == (pytest.approx(3.2), pytest.approx(3.2))


def test_no_task_starts_after_stop_even_where_the_navigator_has_not_heard_of_it(robot):
    last_task = robot.status().task_id
    robot.estop()
    for start in (lambda: robot.goto(0, 0), robot.explore):
        with pytest.raises(UserError, match="STOP is pressed") as refused:
            start()
        assert refused.value.hint == "release it: zenav estop --release"
    robot.estop(press=False)
    assert robot.goto(0, 0).good
    assert robot.status().task_id == last_task + 1


def test_a_task_may_be_canceled(robot):
    robot.cancel()
    assert robot.client.wait(topics.NAV_STATUS, lambda status: status.state is NavState.CANCELED, 30.0) is not None
