# SPDX-License-Identifier: Apache-2.0
"""The whole stack on an emulated board, from its bytes up: it drives, and whatever breaks stops it in time."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from services.sim.dynamics import LEFT_ANGLE, RIGHT_ANGLE
from services.sim.service import SimService
from shared import requests
from shared.messages import BoardReport, GuardState
from shared.requests import Break
from tests.lockstep.stack import MS, QUICK, LockstepStack
from tests.lockstep.test_faults import by_hand

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

EMULATED = ("sim.hardware=emulated", "sim.emulation.laser_model=''", "base_driver.port.device=wired")

STOPS = {
    "garbage": ("board_silent", "bytes arrive, none make sense: check base_driver.port.baud and .device"),
    "half_packets": ("board_silent", "bytes arrive, none make sense: check base_driver.port.baud and .device"),
    "bad_crc": ("board_silent", "packets arrive, but their checksums are wrong"),
    "stalled": ("board_silent", "no byte arrives"),
    "unplugged": ("port_closed", "unplugged"),
    "stuck_encoder": ("wheel_stuck", "the left wheel is commanded but does not turn"),
    "dead_sonar": ("sensor_dead", "ultrasonic 1 does not answer"),
    "swapped_motor": ("wheel_astray", "the left wheel turns at"),
    "low_battery": ("battery_empty", "battery low: 5.5 V"),
}
"""Fault, what the base says of it, and how its words begin."""

LATCHED = ("wheel_stuck", "wheel_astray")


def wheels_agree(stack: LockstepStack) -> None:
    """What the driver counts is what the wheels have turned, but for the encoders' steps."""
    told, true = stack.newest["base/wheels"], stack.lockstep.service("sim").state_now[LEFT_ANGLE : RIGHT_ANGLE + 1]
    step = 2 * np.pi / stack.file.robot.drive.counts_per_turn
    assert abs(told.left - true[0]) <= step
    assert abs(told.right - true[1]) <= step


@pytest.mark.parametrize("hardware", [EMULATED, ()], ids=["bytes", "messages"])
def test_the_robot_reaches_its_goal_and_its_wheels_are_counted_right(tmp_path, hardware):
    stack = LockstepStack(tmp_path, settings=(*hardware, *QUICK))
    stack.go(4.5, 0.5)
    stack.until(stack.reached, 30.0)
    stack.lockstep.run(1.0)
    assert stack.truth.n_contacts == 0
    assert stack.truth.distance > 4.0
    wheels_agree(stack)
    if hardware:
        status = stack.newest["base/board"]
        assert (status.bad_crc, status.resyncs, status.skipped) == (0, 0, 0)
        assert status.rate == pytest.approx(50, abs=2)
        emulated = stack.lockstep.service("sim").emulation.board.electronics
        assert {channel: (g.kp, g.kd, g.ki) for channel, g in emulated.gains.items()} == dict.fromkeys(
            (0, 1), (15, 0, 0)
        )
        assert emulated.n_acknowledged >= 5


@pytest.fixture
def driving(tmp_path):
    """At full speed towards a goal four metres ahead."""
    stack = LockstepStack(tmp_path, settings=(*EMULATED, *QUICK))
    stack.go(4.0)
    stack.drives()
    return stack


def turning(stack: LockstepStack) -> bool:
    """Whether the board drives a motor, whatever the last command was and whether it arrived."""
    return any(stack.lockstep.service("sim").emulation.board.motors(stack.now)[:2])


def breaks(stack: LockstepStack, fault: str, seconds: float = 0.0) -> None:
    assert stack.lockstep.ask(requests.FAULT, Break(stack.now, fault, seconds, False)).accepted


def mended(stack: LockstepStack) -> None:
    reply = stack.lockstep.ask(requests.FAULT, Break(stack.now, "", 0.0, True))
    assert (reply.accepted, reply.detail) == (True, "nothing is broken")


@pytest.mark.parametrize("fault", STOPS)
def test_a_broken_board_stops_the_robot_in_300_ms_says_why_and_drives_on_when_it_is_mended(driving, fault):
    reason, words = STOPS[fault]
    breaks(driving, fault)
    assert driving.until(lambda: not (driving.commanded or turning(driving)), 1.0) <= 300 * MS
    driving.until(lambda: driving.newest["base/status"].fault == reason, 0.5)
    driving.lockstep.run(0.3)
    status, guard = driving.newest["base/status"], driving.guard
    assert status.fault == guard.reason == reason
    assert guard.state is GuardState.FAULT
    assert status.detail.startswith(words)
    assert guard.detail == status.detail
    driving.until(lambda: abs(driving.truth.v) < 0.01, 1.0)
    driving.stands_for(1.0)
    mended(driving)
    driving.lockstep.run(1.0)
    if reason in LATCHED:
        assert driving.guard.reason == reason
        driving.stands_for(0.5)
        driving.stop(False)
    driving.until(lambda: driving.newest["base/status"].fault == "", 0.5)
    driving.stands_for(0.3)
    driving.go(3.5)
    driving.until(driving.reached, 40.0)
    assert driving.truth.n_contacts == 0
    assert driving.newest["base/status"].fault == ""


def test_a_fault_of_a_moment_stops_nothing(driving):
    for fault in ("garbage", "half_packets", "bad_crc", "stalled"):
        breaks(driving, fault, seconds=0.1)
        driving.lockstep.run(0.3)
        assert driving.newest["base/status"].fault == ""
    driving.until(driving.reached, 30.0)
    driving.lockstep.run(1.0)  # until the wheels stand: their newest count is of a moment before now
    assert driving.newest["base/board"].bad_crc > 0
    assert driving.newest["base/board"].resyncs > 0
    wheels_agree(driving)


def test_when_the_driver_dies_the_board_s_time_limit_stops_the_wheels_and_a_new_one_drives(driving):
    driving.lockstep.kill("base_driver")
    driving.until(lambda: abs(driving.truth.v) < 0.02, 1.2)  # 0.2 s of limit, then the wheels roll out
    driving.lockstep.run(1.0)
    driving.start("base_driver")
    driving.until(driving.ended, 40.0)
    assert driving.truth.n_contacts == 0


def test_the_same_seed_and_faults_give_the_same_bytes(tmp_path):
    def run() -> list[bytes]:
        said: list[bytes] = []
        stack = LockstepStack(tmp_path, settings=(*EMULATED, *QUICK))
        for key in ("port/tx/sim", "port/tx/base_driver"):
            stack.lockstep.watch(key, lambda message: said.append(message.data))
        stack.go(3.0)
        stack.lockstep.run(1.0)
        breaks(stack, "garbage", seconds=0.3)
        stack.lockstep.run(1.0)
        return said

    assert run() == run()


class BadBoard(SimService):
    """A board that speaks in messages; from a moment on, they are changed."""

    changed: Callable[[BoardReport], BoardReport] | None = None

    def _board(self) -> BoardReport:
        report = super()._board()
        return report if self.changed is None else self.changed(report)


def random_counts(report: BoardReport, rng: np.random.Generator) -> BoardReport:
    """Counts of no wheel."""
    return replace(report, left_counts=int(rng.integers(32768)), right_counts=int(rng.integers(32768)))


def half_random(report: BoardReport, rng: np.random.Generator) -> BoardReport:
    """Counts of no wheel in half of the reports."""
    return random_counts(report, rng) if rng.random() < 0.5 else report


MESSAGES = {
    "random counts": (random_counts, "encoders_jump", "the encoders jumped "),
    "half of the counts random": (half_random, "encoders_jump", "the encoders jumped "),
    "dead sonars": (
        lambda report, _: replace(report, ultrasonic=np.zeros_like(report.ultrasonic)),
        "sensor_dead",
        "ultrasonic 0 and 1 and 2 does not answer",
    ),
    "no sonars": (
        lambda report, _: replace(report, ultrasonic=np.empty(0, np.float32)),
        "wrong_ranges",
        "the board sends 0 ultrasonic ranges, robot.ranges has 3",
    ),
    "more infrared": (
        lambda report, _: replace(report, infrared=np.append(report.infrared, np.float32(1.0))),
        "wrong_ranges",
        "the board sends 8 infrared ranges, robot.ranges has 7",
    ),
}
"""How a board's messages are wrong, what the base says of it, and how its words begin."""
LIMITS = {"random counts": 250, "half of the counts random": 600}
"""ms to the motors' zero, where it is not 300."""


@pytest.mark.parametrize("how", ["teleop", "nav"])
@pytest.mark.parametrize("case", MESSAGES)
def test_a_board_whose_messages_are_wrong_stops_the_robot_says_why_and_drives_on_when_they_are_right(
    tmp_path, case, how
):
    wrong, reason, words = MESSAGES[case]
    rng = np.random.default_rng(3)
    stack = LockstepStack(tmp_path, sim=BadBoard, settings=QUICK)
    if how == "teleop":
        by_hand(stack)
        stack.drives(0.38)
    else:
        stack.go(4.0)
        stack.drives()
    sim = stack.lockstep.service("sim")
    sim.changed = lambda report: wrong(report, rng)
    assert stack.until(lambda: not stack.commanded, 1.0) <= LIMITS.get(case, 300) * MS
    stack.until(lambda: abs(stack.truth.v) < 0.01, 1.0)
    for _ in range(20):
        stack.stands_for(0.1)
        assert stack.newest["base/status"].fault == stack.guard.reason == reason
        assert stack.newest["base/status"].detail.startswith(words)
        assert stack.guard.detail.startswith(words)
    sim.changed = None
    stack.until(lambda: stack.newest["base/status"].fault == "", 1.5)
    if how == "teleop":
        stack.drives(0.35)
    else:
        if stack.ended():  # a fault of the hardware ends the task, as on the serial board
            stack.lockstep.run(0.3)
            stack.go(4.0)
        stack.until(stack.reached, 40.0)
        here = stack.truth.start @ stack.newest["pose"].map_from_base
        assert here.distance(stack.truth.world_from_base) < 0.15
    assert stack.truth.n_contacts == 0


def test_counts_that_jump_for_a_moment_again_and_again_need_a_person(tmp_path):
    stack = LockstepStack(tmp_path, sim=BadBoard, settings=QUICK)
    by_hand(stack)
    sim, rng = stack.lockstep.service("sim"), np.random.default_rng(4)
    for _ in range(3):
        stack.drives(0.3)
        sim.changed = lambda report: random_counts(report, rng)
        stack.lockstep.run(0.2)
        sim.changed = None
        stack.until(lambda: abs(stack.truth.v) < 0.01, 1.0)
    stack.stands_for(3.0)
    assert (stack.guard.state, stack.guard.reason) == (GuardState.FAULT, "encoders_broken")
    stack.stop(False)
    stack.lockstep.run(0.5)
    assert stack.newest["base/status"].fault == ""
