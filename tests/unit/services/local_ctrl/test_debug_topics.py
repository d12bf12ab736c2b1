# SPDX-License-Identifier: Apache-2.0
"""The debug topics of local control. A client that listens to them changes no command."""

import numpy as np
import pytest

from services.local_ctrl.debug_topics import moving_obstacles
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Costmap, Rollouts
from shared.requests import Watch
from shared.topics import Publication
from tests.unit.services.local_ctrl.tiny_world import ControlLoop, TinyWorld, drive_goal, planned

ROBOT = load_robot("x80sv").robot
START, GOAL = Pose2(1.0, 2.0, 0.0), Pose2(6.0, 2.0, 0.0)


def watched(loop: ControlLoop, seconds: float = 5.0) -> None:
    loop.service.now = loop.now
    asked = loop.service.watch(Watch(loop.now, seconds))
    assert list(asked) == []


def pictures(loop: ControlLoop) -> dict[str, Costmap | Rollouts]:
    """What the next tick shows."""
    loop.service.now = loop.now
    sent = [out for out in loop.service.tick() if isinstance(out, Publication)]
    return {p.topic.key: p.message for p in sent if p.topic in (topics.COSTMAP, topics.ROLLOUTS)}


def driving(seconds: float = 1.5) -> ControlLoop:
    world = TinyWorld(8, 4)
    world.box(3.8, 2.8, 4.2, 3.2)
    loop = ControlLoop(ROBOT, world, START).give(drive_goal(GOAL), planned(world, START, GOAL, 0.25))
    loop.drive(seconds)
    return loop


def test_it_shows_nothing_until_somebody_watches_and_nothing_after():
    loop = driving()
    assert pictures(loop) == {}
    watched(loop, 1.0)
    assert set(pictures(loop)) == {"debug/costmap", "debug/rollouts"}
    assert pictures(loop) == {}, "five times a second are enough"
    loop.now += 2_000_000_000
    assert pictures(loop) == {}


def test_an_obstacle_and_the_robot_stand_in_the_costmap_where_they_are():
    loop = driving()
    watched(loop)
    costmap = pictures(loop)["debug/costmap"]
    odom_from_world = loop.service.inputs.odometry.odom_from_base @ loop.truth.inverse()

    def cost(x: float, y: float) -> int:
        at = odom_from_world @ Pose2(x, y, 0.0)
        row, column = (at.y - costmap.y) / costmap.resolution, (at.x - costmap.x) / costmap.resolution
        return int(costmap.cells[int(row), int(column)])

    near = [cost(4.0 + dx, 2.8 + dy) for dx in (-0.1, 0.0, 0.1) for dy in (-0.05, 0.0, 0.05)]  # its lower side
    assert max(near) == 100
    assert cost(loop.truth.x, loop.truth.y) < 100
    assert cost(loop.truth.x + 0.8, 2.0) < 50


def test_the_rollouts_begin_at_the_robot_and_the_first_goes_its_way():
    loop = driving()
    watched(loop)
    rollouts = pictures(loop)["debug/rollouts"]
    start = loop.service.start.pose
    np.testing.assert_allclose(rollouts.xs[:, 0], start.x, atol=1e-5)
    np.testing.assert_allclose(rollouts.ys[:, 0], start.y, atol=1e-5)
    length = np.hypot(np.diff(rollouts.xs, axis=1), np.diff(rollouts.ys, axis=1)).sum(axis=1)
    assert length[0] > 0.3
    end = Pose2(float(rollouts.xs[0, -1]), float(rollouts.ys[0, -1]), 0.0)
    assert abs(start.bearing(end) - start.yaw) < 0.5


def test_being_watched_changes_no_command():
    ways = []
    for watching in (False, True):
        loop = driving(0.5)
        if watching:
            watched(loop, 60.0)
        loop.drive(2.0)
        ways.append([(c.stamp, c.v, c.w) for c in loop.run.commands])
    assert ways[0] == ways[1]
    assert len(ways[0]) > 30


def keys_shown(loop: ControlLoop) -> set[str]:
    """Of the next tick in which the debug topics are due."""
    loop.now += 500_000_000
    watched(loop)
    return {out.topic.key for out in loop.service.tick() if isinstance(out, Publication)}


def test_moving_obstacles_are_shown_where_they_are_tracked_only():
    loop = driving()
    assert "debug/moving_obstacles" not in keys_shown(loop)
    costmap = loop.service.costmap
    tracked = costmap.config.dynamic_obstacles.model_copy(update={"enabled": True})
    costmap.configure(costmap.config.model_copy(update={"dynamic_obstacles": tracked}))
    assert "debug/moving_obstacles" in keys_shown(loop)


def test_a_moving_obstacle_is_shown_with_its_velocity_and_radius():
    shown = moving_obstacles(5, np.array([[1.0, 2.0, 0.5, -0.5, 0.3, 0.1]]))
    columns = shown.xs, shown.ys, shown.vxs, shown.vys, shown.radii
    assert [column.tolist() for column in columns] == [[1.0], [2.0], [0.5], [-0.5], [pytest.approx(0.3)]]
    assert len(moving_obstacles(5, np.empty((0, 6))).xs) == 0
