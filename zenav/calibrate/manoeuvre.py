# SPDX-License-Identifier: Apache-2.0
"""Manoeuvres of a calibration: generators that receive what is seen, and yield what they ask for.

They use no transport and no clock. So a running stack and the virtual clock drive the same manoeuvres.
"""

from collections.abc import Generator
from dataclasses import dataclass
from math import copysign, hypot, pi, sqrt
from typing import TypeVar

from shared.config import Drive, UserError
from shared.geometry import Pose2, wrapped
from shared.messages import GuardState, GuardStatus, Odometry, PoseEstimate
from shared.reasons import REASONS

T = TypeVar("T")

HZ = 20
FRESH = 0.5  # s after its stamp that a message counts as current
MAX_WAIT_S = 4.0  # s that the guard may hold the robot, or an input be missing, before the manoeuvre gives up
GENTLE = 0.5  # of the drive's accelerations: a wheel that slips measures nothing
NEAR, NEAR_TURN = 0.004, 0.004  # m, rad: arrived
CREEP, CREEP_TURN = 0.03, 0.06  # m/s, rad/s: the last of the way
BEHIND = 0.15  # s from a command to the wheels' answer


@dataclass(frozen=True, slots=True)
class StackState:
    """What is known at a step: ns on the stack's clock, and the newest of each message."""

    now: int
    odom: Odometry | None = None
    pose: PoseEstimate | None = None
    guard: GuardStatus | None = None


@dataclass(frozen=True, slots=True)
class VelocityStep:
    """A velocity (m/s, rad/s), whether to press STOP, and a line for the operator, or none."""

    v: float = 0.0
    w: float = 0.0
    stop: bool = False
    say: str = ""


Manoeuvre = Generator[VelocityStep, StackState, T]


class Deadline:
    """Raises UserError where the guard holds the robot, or odometry is silent, for too long."""

    def __init__(self, seconds: float = float("inf")) -> None:
        self._good: int | None = None
        self._begun: int | None = None
        self._seconds = seconds

    def check(self, seen: StackState) -> None:
        """Once a step. After `seconds` in all, the manoeuvre has failed."""
        self._begun = seen.now if self._begun is None else self._begun
        silent = seen.odom is None or seen.now - seen.odom.stamp > FRESH * 1e9
        guard = seen.guard
        is_stopped = guard is None or guard.state in (GuardState.HOLD, GuardState.STOPPED, GuardState.FAULT)
        if not silent and not is_stopped:
            self._good = seen.now
        stuck = seen.now - (self._begun if self._good is None else self._good) > MAX_WAIT_S * 1e9
        over = seen.now - self._begun > self._seconds * 1e9
        if not stuck and not over:
            return
        if guard is None:
            raise UserError("the guard does not answer", "start the stack: zenav up")
        if silent:
            raise UserError("odometry is silent", "is odometry running? zenav topic hz odom")
        reason = REASONS.get(guard.reason)
        why = f": {reason.text}" if reason else ""
        hint = reason.hint if reason else "see guard/status: zenav topic echo guard/status"
        raise UserError(f"the robot does not get where it should{why}", hint)


def stand(seconds: float, say: str = "") -> Manoeuvre[StackState]:
    """Stands for so long; returns what is seen at the end."""
    seen = yield VelocityStep(say=say)
    end = seen.now + round(seconds * 1e9)
    while seen.now < end:
        seen = yield VelocityStep()
    return seen


def ready() -> Manoeuvre[StackState]:
    """Stands until odometry and guard answer."""
    patience = Deadline()
    seen = yield from stand(0.3)
    while seen.odom is None or seen.guard is None:
        patience.check(seen)
        seen = yield VelocityStep()
    patience.check(seen)
    return seen


def ask_once(ask: VelocityStep, patience: Deadline) -> Manoeuvre[Odometry]:
    """Asks it once, then stands until there is odometry, and returns that."""
    seen = yield ask
    patience.check(seen)
    while seen.odom is None:
        seen = yield VelocityStep()
        patience.check(seen)
    return seen.odom


def turn_to(yaw: float, rate: float, drive: Drive, start: Pose2) -> Manoeuvre[None]:
    """Turns on the spot to a heading by odometry, seen from `start` (odom_from_start), the short way round."""
    patience = Deadline(3 * pi / rate + 10)
    ask = VelocityStep()
    while True:
        odom = yield from ask_once(ask, patience)
        left = wrapped(yaw - (start.inverse() @ odom.odom_from_base).yaw)
        ahead = left - odom.w * BEHIND
        if abs(left) < NEAR_TURN and abs(odom.w) < CREEP_TURN / 2:
            return
        w = min(rate, sqrt(2 * GENTLE * drive.max_turn_acceleration * abs(ahead)), 2.5 * abs(ahead))
        w = max(w, CREEP_TURN) if abs(left) >= NEAR_TURN else 0.0
        ask = VelocityStep(0.0, copysign(w, ahead))


def line_to(a: Pose2, length: float, speed: float, drive: Drive, start: Pose2) -> Manoeuvre[None]:
    """Drives along a line by odometry: from `a` (start_from_a), ahead by `length` m."""
    patience = Deadline(3 * length / speed + 10)
    ask = VelocityStep()
    while True:
        odom = yield from ask_once(ask, patience)
        here = (start @ a).inverse() @ odom.odom_from_base
        left = length - here.x - odom.v * BEHIND
        if left < NEAR:
            return
        v = max(min(speed, sqrt(2 * GENTLE * drive.max_braking * left), 2.5 * left), CREEP)
        # to the line, within half a metre of way: a slow S, no corner
        w = -v * (here.y * 8.0 + wrapped(here.yaw) * 4.0)
        ask = VelocityStep(v, max(-0.5, min(0.5, w)))


def square(side: float, clockwise: bool, speed: float, rate: float, drive: Drive) -> Manoeuvre[None]:
    """Once round a square by odometry, from here, the first side ahead; ends where odometry says that it began."""
    seen = yield from ready()
    assert seen.odom is not None
    start = seen.odom.odom_from_base
    corner, turn = Pose2(), -pi / 2 if clockwise else pi / 2
    for _ in range(4):
        yield from line_to(corner, side, speed, drive, start)
        yield from stand(0.2)
        corner = corner @ Pose2(side, 0.0, turn)
        yield from turn_to(corner.yaw, rate, drive, start)
        yield from stand(0.2)


def back_to(map_from_place: Pose2, speed: float, rate: float, drive: Drive) -> Manoeuvre[None]:
    """Drives to a pose on the map, by odometry from where the mapper sees the robot now."""
    seen = yield from ready()
    if seen.pose is None or seen.odom is None:
        raise UserError("the mapper gives no pose", "is it running? zenav topic hz pose; or use --measured")
    start = seen.odom.odom_from_base
    goal = start.inverse() @ seen.pose.map_from_odom.inverse() @ map_from_place
    far = hypot(goal.x, goal.y)
    if far > 0.02:
        heading = Pose2().bearing(goal)
        yield from turn_to(heading, rate, drive, start)
        yield from line_to(Pose2(0.0, 0.0, heading), far, speed, drive, start)
    yield from turn_to(goal.yaw, rate, drive, start)


def umbmark_drive(side: float, n_runs: int, speed: float, rate: float, drive: Drive, again: bool) -> Manoeuvre[None]:
    """Squares both ways by turns, `n_runs` each; between two the robot drives back to its start by the map (again).

    It stands for 1.5 s before and after each.
    """
    seen = yield from ready()
    home = seen.pose.map_from_base if seen.pose is not None else None
    for i in range(2 * n_runs):
        if i and again and home is not None:
            yield from back_to(home, speed, rate, drive)
        direction = "clockwise" if i % 2 == 0 else "counter-clockwise"
        yield from stand(1.5, f"square {i + 1} of {2 * n_runs}, {direction}")
        yield from square(side, i % 2 == 0, speed, rate, drive)
        yield from stand(1.5)
