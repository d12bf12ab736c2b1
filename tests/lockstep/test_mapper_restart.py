# SPDX-License-Identifier: Apache-2.0
"""A mapper that died comes back with its map, and with the robot where it has driven to meanwhile."""

import pytest

from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import Localization, PoseEstimate, Velocity
from shared.runners.lockstep import Lockstep
from zenav.stack.service_loader import build_service


class RestartDrive:
    """The lower half of the stack in a room, commanded in the guard's name."""

    def __init__(self, world: str) -> None:
        self.file = load_robot("x80sv")
        self.file.override(f"sim.world={world}")
        self.robot = self.file.robot
        names = ("sim", "base_driver", "odometry", "mapper")
        self.stack = Lockstep({name: build_service(name, self.file, self.robot) for name in names})
        self.velocity = (0.0, 0.0)
        self.stack.watch("sim/truth", lambda truth: setattr(self, "truth", truth))
        self.command()

    def command(self) -> None:
        v, w = self.velocity
        self.stack.publish(topics.CMD_VEL(Velocity(self.stack.now, v, w, "")), publisher="guard")
        self.stack.at(0.05, self.command)

    def go(self, v: float, w: float, seconds: float) -> None:
        self.velocity = v, w
        self.stack.run(seconds)

    def restart(self, name: str) -> None:
        self.stack.start(name, build_service(name, self.file, self.robot))

    @property
    def estimate(self) -> PoseEstimate:
        return self.stack.latched["pose"].message

    def error(self) -> tuple[float, float]:
        """m and rad between the estimate and the truth, both of a robot that stands."""
        true: Pose2 = self.truth.start.inverse() @ self.truth.world_from_base
        estimate = self.estimate.map_from_base
        return true.distance(estimate), abs(wrapped(true.yaw - estimate.yaw))


def test_a_restarted_mapper_has_its_map_and_knows_how_far_the_robot_came_meanwhile():
    drive = RestartDrive("room")
    drive.go(0.0, 0.0, 1.0)
    drive.go(0.2, 0.3, 6.0)
    before, tiles = drive.stack.latched["map"].message, drive.estimate.stamp
    drive.stack.kill("mapper")
    drive.go(0.2, -0.3, 2.0)
    drive.go(0.0, 0.0, 0.5)
    assert drive.estimate.stamp == pytest.approx(tiles, abs=2e8)  # no estimate is published meanwhile
    drive.restart("mapper")
    drive.go(0.0, 0.0, 2.0)
    after = drive.stack.latched["map"].message
    assert after.map_id == before.map_id
    assert after.version >= before.version
    assert len(after.rows) >= len(before.rows)
    assert drive.estimate.state is Localization.GOOD
    distance, turn = drive.error()
    assert distance < 0.05
    assert turn < 0.03
    drive.go(0.2, 0.3, 3.0)
    drive.go(0.0, 0.0, 0.5)
    assert drive.error()[0] < 0.05


def test_odometry_that_was_restarted_too_does_not_carry_the_robot_away():
    drive = RestartDrive("room")
    drive.go(0.0, 0.0, 1.0)
    drive.go(0.2, 0.3, 6.0)
    drive.go(0.0, 0.0, 0.5)
    for name in ("mapper", "odometry"):
        drive.stack.kill(name)
    drive.go(0.0, 0.0, 1.0)
    for name in ("mapper", "odometry"):
        drive.restart(name)
    drive.go(0.0, 0.0, 2.0)
    assert drive.error()[0] < 0.05
    assert drive.estimate.state is Localization.GOOD
