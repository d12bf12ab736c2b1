# SPDX-License-Identifier: Apache-2.0
"""What makes no sense or cannot be done ends in a state that says why, with the robot standing and nothing touched."""

from dataclasses import replace

import numpy as np
import pytest

from services.sim.service import SimService
from shared import topics
from shared.geometry import Pose2
from shared.grid import update_of_cells
from shared.messages import LaserScan, NavState
from shared.reasons import REASONS
from tests.lockstep.stack import MS, LockstepStack
from tests.lockstep.test_faults import Pose

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

QUICK = (
    "local_ctrl.mppi.rollouts=100",
    "navigator.leg={progress_time: 3, blocked_time: 0.6, unreachable_time: 1}",
    "navigator.recovery={wait: 0.4, turn: 0.5, deadline: 1}",
)
NARROW = """
start: {x: 1.0, y: 1.5}
walls:
  - {points: [[0, 0], [6, 0], [6, 3], [0, 3]], closed: true}
boxes:
  - {x: 3.0, y: 0.65, size: [1.0, 1.3]}
  - {x: 3.0, y: 2.35, size: [1.0, 1.3]}
"""
"""Two halves of a room, and between them a corridor as wide as the robot's footprint."""


def ends_with(stack: LockstepStack, state: NavState, *reasons: str, seconds: float = 60.0) -> None:
    """The task ends so, its reason has words and a hint, and the robot stands."""
    stack.until(stack.ended, seconds)
    status = stack.newest["nav/status"]
    assert status.state is state
    assert status.reason in reasons, status
    assert REASONS[status.reason].hint
    stack.until(lambda: not stack.commanded, 1.0)
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.0)
    stack.stands_for(1.0)
    assert stack.truth.n_contacts == 0


def test_a_corridor_as_narrow_as_the_robot_is_no_way_and_what_lies_beyond_is_unreachable(tmp_path):
    stack = LockstepStack(tmp_path, NARROW, settings=QUICK)
    begun = stack.truth.world_from_base
    stack.go(4.0)
    ends_with(stack, NavState.FAILED, "unreachable", seconds=10.0)
    assert stack.truth.world_from_base.distance(begun) < 0.1
    stack.go(0.8)
    stack.until(stack.ended, 20.0)
    assert stack.reached()


def test_a_map_that_changes_under_the_plan_stops_the_robot_or_ends_the_task(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.go(6.5)
    stack.drives(0.6)
    grid = stack.lockstep.service("navigator").navigation.grid
    cells = grid.cells.copy()
    # far ahead: what is near the laser sees through, and the planner waits a moment whether it goes again
    column = int((4.8 - grid.x0) / grid.resolution)
    cells[:, column : column + 3] = 100
    walled = update_of_cells(cells, grid.resolution, grid.x0, grid.y0)
    Pose(stack)
    stack.lockstep.publish(
        topics.MAP(replace(walled, map_id=grid.map_id, version=grid.version + 1, stamp=stack.now)), "mapper"
    )
    ends_with(stack, NavState.FAILED, "unreachable", "recoveries_used")
    assert stack.truth.world_from_base.x < 1.0 + 4.8
    stack.go(0.5)
    stack.drives(0.1)
    stack.lockstep.publish(topics.MAP(replace(walled, map_id=grid.map_id + 1, stamp=stack.now)), "mapper")
    ends_with(stack, NavState.CANCELED, "other_map", seconds=1.0)


def test_a_pose_that_jumps_by_a_metre_holds_the_robot_until_it_has_planned_again(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.go(4.0)
    stack.drives()
    pose = Pose(stack)
    stack.lockstep.run(0.3)
    pose.shift = 1.0
    assert stack.until(lambda: not stack.commanded, 1.0) <= 150 * MS
    assert stack.guard.reason == "pose_jumped"
    stack.lockstep.run(1.0)
    pose.shift = 0.0
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0


class Walled(SimService):
    """From a moment on, every beam ends a few centimetres before the robot's body."""

    near = False

    def _due_scans(self) -> list[LaserScan]:
        return [self._near(scan) if self.near else scan for scan in super()._due_scans()]

    def _near(self, scan: LaserScan) -> LaserScan:
        mount = self.robot.laser.mount
        laser_from_base = Pose2(mount.x, mount.y, mount.yaw).inverse()
        angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        # to the circle of 0.3 m around the robot
        along = laser_from_base.x * np.cos(angles) + laser_from_base.y * np.sin(angles)
        square = laser_from_base.x**2 + laser_from_base.y**2
        # as noisy as a laser is: equal scans are a fault of their own
        noise = np.random.default_rng(scan.stamp).normal(0.0, 0.005, len(angles))
        return replace(scan, ranges=(along + np.sqrt(along**2 - square + 0.3**2) + noise).astype(np.float32))


def test_where_there_is_nothing_but_obstacles_the_robot_stands_and_gives_up_with_the_reason(tmp_path):
    stack = LockstepStack(tmp_path, sim=Walled, settings=QUICK)
    stack.go(6.5)
    stack.drives()
    Pose(stack)  # the mapper would be lost, and that a reason of its own
    stack.lockstep.service("sim").near = True
    stack.until(lambda: abs(stack.truth.v) < 0.01, 3.0)
    assert stack.guard.reason in ("obstacle", "blocked")
    stands = stack.truth.world_from_base
    ends_with(stack, NavState.FAILED, "recoveries_used", "start_blocked", "unreachable", seconds=60.0)
    assert stack.truth.world_from_base.distance(stands) < 0.1
