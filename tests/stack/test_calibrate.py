# SPDX-License-Identifier: Apache-2.0
"""Calibration drives on real processes: whatever ends a drive, the robot stands."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared import topics
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import EmergencyStop, GuardState, Truth
from tests.stack.processes import ROBOT, StackProcesses, running
from zenav.calibrate.live import ManoeuvreRunner
from zenav.calibrate.manoeuvre import Manoeuvre, VelocityStep, stand, turn_to

DRIVERS = ("sim", "base_driver", "odometry", "guard")


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StackProcesses]:
    folder: Path = tmp_path_factory.mktemp("calibrate")
    with running(folder, DRIVERS, "empty") as stack:
        stack.until(lambda: stack.client.latest(topics.GUARD) and stack.client.latest(topics.TRUTH))
        yield stack


@pytest.fixture
def operator(stack: StackProcesses) -> Iterator[ManoeuvreRunner]:
    with ManoeuvreRunner(ROBOT, str(stack.where.domain)) as operator:
        yield operator


def truth(stack: StackProcesses) -> Truth:
    found = stack.client.latest(topics.TRUTH)
    assert found is not None
    return found


def spin(press: bool = False) -> Manoeuvre[None]:
    """Turns for ever, after a while with STOP pressed."""
    for _ in range(40):
        yield VelocityStep(0.0, 0.5)
    while True:
        yield VelocityStep(0.0, 0.5, stop=press)


def when_it_turns(stack: StackProcesses, action: Callable[[], None]) -> threading.Thread:
    def wait() -> None:
        stack.client.wait(topics.TRUTH, lambda t: abs(t.w) > 0.3, 30.0)
        action()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def stands(stack: StackProcesses) -> None:
    stack.until(lambda: truth(stack).w == pytest.approx(0, abs=0.01))
    yaw = truth(stack).world_from_base.yaw
    threading.Event().wait(0.5)
    assert truth(stack).world_from_base.yaw == pytest.approx(yaw, abs=0.01)


def test_a_manoeuvre_is_driven_and_heard(stack, operator):
    start = operator.perform(stand(0.5)).odom
    assert start is not None
    operator.perform(turn_to(1.0, 1.0, ROBOT.drive, start.odom_from_base))
    stands(stack)
    seen = operator.perform(stand(0.2)).odom
    assert seen is not None
    assert (start.odom_from_base.inverse() @ seen.odom_from_base).yaw == pytest.approx(1.0, abs=0.05)
    assert len(operator.log.wheels) > 50
    assert len(operator.log.scans) > 10
    assert len(operator.log.motors) > 50
    assert Pose2() != operator.log.truth[-1].world_from_base


def test_ctrl_c_stops_the_robot(stack, operator):
    thread = when_it_turns(stack, lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        operator.perform(spin())
    thread.join()
    stands(stack)


def test_an_error_while_stop_is_pressed_by_us_leaves_a_standing_robot_without_stop(stack, operator):
    def pressed() -> None:
        stack.client.wait(topics.GUARD, lambda g: g.state is GuardState.STOPPED, 30.0)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=pressed)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        operator.perform(spin(press=True))
    thread.join()
    stands(stack)
    stack.until(lambda: stack.client.latest(topics.GUARD).state is not GuardState.STOPPED)


def test_somebody_else_s_stop_ends_the_drive_and_stays(stack, operator):
    def press() -> None:
        stack.client.publish(topics.ESTOP(EmergencyStop(stack.client.now(), True, "somebody")))

    thread = when_it_turns(stack, press)
    with pytest.raises(UserError, match="somebody pressed STOP"):
        operator.perform(spin())
    thread.join()
    stands(stack)
    assert stack.client.latest(topics.GUARD).state is GuardState.STOPPED
    with pytest.raises(UserError, match="somebody pressed STOP"):
        operator.perform(stand(2.0))
    stack.client.publish(topics.ESTOP(EmergencyStop(stack.client.now(), False, "somebody")))
    stack.until(lambda: stack.client.latest(topics.GUARD).state is not GuardState.STOPPED)
