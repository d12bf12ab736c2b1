# SPDX-License-Identifier: Apache-2.0
"""What moves a robot, as processes, treated badly: one run for all, which each test leaves as it found it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from shared import topics
from shared.codec import Envelope, encode
from shared.messages import EmergencyStop, GuardState, Velocity
from shared.runners import transport
from tests.stack.processes import ROBOT, StackProcesses, running
from zenav.client import Client
from zenav.client.gamepad import DEAD_MAN_BUTTONS, EV_KEY, EVENT, STOP_BUTTON

DEAD_MAN = min(DEAD_MAN_BUTTONS)


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Iterator[StackProcesses]:
    """No service that sends the robot anywhere."""
    with running(tmp_path_factory.mktemp("bare"), ("sim", "base_driver", "odometry", "guard")) as stack:
        stack.until(lambda: None not in (stack.client.latest(topics.GUARD), stack.client.latest(topics.TRUTH)))
        yield stack


def test_a_second_publisher_on_cmd_vel_moves_nothing_and_is_told(bare):
    place = bare.client.latest(topics.TRUTH).world_from_base
    with transport.opened(bare.where) as intruder:
        publisher = intruder.declare_publisher(f"{ROBOT.name}/cmd/vel")
        sequence = 0

        def intrude() -> bool:
            nonlocal sequence
            for name in ("guard", "operator", "local_ctrl"):
                now = bare.client.now()
                publisher.put(encode(Velocity(now, 0.5, 0.0, ""), Envelope(name, "other", sequence, now)))
            sequence += 1
            return bare.healths["base_driver"].intruders > 3

        bare.until(intrude)
    assert bare.client.latest(topics.TRUTH).world_from_base.distance(place) < 0.01
    assert "second publisher" in bare.healths["base_driver"].last_error


def test_without_scans_the_robot_stands_and_says_why(bare):
    os.kill(bare.pid("sim"), signal.SIGSTOP)
    bare.until(lambda: bare.client.latest(topics.GUARD).state in (GuardState.HOLD, GuardState.FAULT))
    assert bare.client.latest(topics.GUARD).reason in ("scan_old", "odom_old", "board_silent")
    os.kill(bare.pid("sim"), signal.SIGCONT)
    bare.until(lambda: bare.client.latest(topics.GUARD).state is GuardState.IDLE)


def test_a_guard_that_is_killed_under_stop_comes_back_stopped(bare):
    def stop(pressed: bool) -> None:
        # as `zenav estop` does: its process ends, and what it had latched with it
        with Client(ROBOT.name, bare.where) as operator:
            operator.publish(topics.ESTOP(EmergencyStop(operator.now(), pressed, "test")))
            bare.until(lambda: (bare.client.latest(topics.GUARD).state is GuardState.STOPPED) == pressed)

    stop(True)
    before = bare.pid("guard")
    os.kill(before, signal.SIGKILL)
    killed = bare.client.now()
    bare.until(lambda: bare.client.latest(topics.GUARD).stamp > killed + 1_000_000_000)
    assert bare.pid("guard") != before
    status = bare.client.latest(topics.GUARD)
    assert (status.state, status.reason) == (GuardState.STOPPED, "estop")
    stop(False)


def test_a_gamepad_drives_while_its_button_is_held_and_one_that_is_gone_stops_the_robot(bare, tmp_path):
    """FIFO for device: without the ranges of axes, so the robot stands; the commands show that it drives."""
    device, sent = tmp_path / "event0", []
    os.mkfifo(device)
    bare.client.listen(topics.TELEOP, lambda command, _: sent.append(command))
    number = str(bare.where.domain)
    command = [sys.executable, "-m", "zenav", "teleop", "--gamepad", "--device", str(device), "--stack", number]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            with open(device, "wb", buffering=0) as pad:  # opens when the tool has opened it
                pad.write(EVENT.pack(0, 0, EV_KEY, DEAD_MAN, 1))
                bare.until(lambda: len(sent) > 5)
            bare.until(lambda: len(sent) > 5 and bare.client.now() - sent[-1].stamp > 500_000_000)
            device.unlink()
            os.mkfifo(device)
            with open(device, "wb", buffering=0) as pad:
                pad.write(EVENT.pack(0, 0, EV_KEY, STOP_BUTTON, 1))
                bare.until(lambda: bare.client.latest(topics.GUARD).state is GuardState.STOPPED)
        finally:
            process.terminate()
    with Client(ROBOT.name, bare.where) as operator:
        operator.publish(topics.ESTOP(EmergencyStop(operator.now(), False, "test")))
        bare.until(lambda: bare.client.latest(topics.GUARD).state is not GuardState.STOPPED)
