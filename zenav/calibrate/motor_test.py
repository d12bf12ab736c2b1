# SPDX-License-Identifier: Apache-2.0
"""How the motors are tried: each wheel alone, slower and slower, in steps, and stopped from full speed."""

from dataclasses import dataclass
from enum import StrEnum
from math import pi

from shared.config import Drive, UserError
from shared.geometry import Pose2
from zenav.calibrate.manoeuvre import GENTLE, Manoeuvre, StackState, VelocityStep, line_to, ready, stand, turn_to

ALONE_SPEED = 0.1  # m/s at the rim
ALONE_FOR = 0.8  # s: under the second after which base_driver calls a wheel stuck that its encoder does not show
FINEST = 0.004  # m/s at the rim: the first command of the dead band's stairs
STAIR_FOR = 0.5  # s for each: 2 mm at the finest, three counts of an X80SV's encoder
LAST_STAIR = 0.10  # m/s
STEP_FOR = 1.6  # s
STEPS = (0.1, 0.2)  # m/s at the rim
REST = 0.8  # s
N_STOPS = 3
CRUISE = 0.6  # s at full speed before STOP
STOPS_FOR = 1.5  # s with STOP pressed


class PhaseKind(StrEnum):
    """What a phase tries."""

    ALONE = "alone"
    STAIRS = "stairs"
    STEP = "step"
    STOP = "stop"


@dataclass(frozen=True, slots=True)
class MotorPhase:
    """A part of the drive, ns; left, right: m/s at the rims that were asked for (the stairs: their direction)."""

    kind: PhaseKind
    begin: int
    end: int
    left: float
    right: float


def rim_speeds_of(left: float, right: float, drive: Drive) -> tuple[float, float]:
    """The velocity (m/s, rad/s) at which the rims run so fast, m/s."""
    return (left + right) / 2, (right - left) / drive.wheel_distance


def motor_drive(drive: Drive, blocks: bool, speed: float) -> Manoeuvre[list[MotorPhase]]:
    """All trials; the stop from `speed` (m/s) only on the floor. Needs `room` ahead; the rest turns on the spot."""
    phases: list[MotorPhase] = []
    yield from ready()
    signs = (1.0, -1.0) if drive.max_reverse_speed >= ALONE_SPEED / 2 else (1.0,)
    for name, left, right in (("left", 1.0, 0.0), ("right", 0.0, 1.0)):
        for sign in signs:
            direction = "forward" if sign > 0 else "backward"
            rim = (sign * ALONE_SPEED * left, sign * ALONE_SPEED * right)
            yield from _hold(phases, PhaseKind.ALONE, *rim, ALONE_FOR, drive, f"the {name} wheel alone, {direction}")
    for sign in (1.0, -1.0):
        yield from _stairs(phases, sign, drive)
    for rim_speed in STEPS:
        for sign in (1.0, -1.0):
            label = f"a step to {rim_speed:g} m/s, on the spot"
            yield from _hold(phases, PhaseKind.STEP, -sign * rim_speed, sign * rim_speed, STEP_FOR, drive, label)
    if not blocks:
        for i in range(N_STOPS):
            yield from _stop(phases, speed, drive, f"a stop from {speed:g} m/s, {i + 1} of {N_STOPS}")
            yield from _about_turn(drive)
    return phases


def stopping_room(drive: Drive, speed: float) -> float:
    """m ahead that a stop from `speed` needs, with a reserve for brakes that reach a third of what is configured."""
    accelerating = speed**2 / (2 * GENTLE * drive.max_acceleration)
    return accelerating + CRUISE * speed + 3 * speed**2 / (2 * drive.max_braking) + 0.5


def _hold(
    phases: list[MotorPhase], kind: PhaseKind, left: float, right: float, seconds: float, drive: Drive, say: str
) -> Manoeuvre[None]:
    """Holds the rims at these speeds, and stands."""
    v, w = rim_speeds_of(left, right, drive)
    seen = yield VelocityStep(v, w, say=say)
    begin = seen.now
    while seen.now < begin + round(seconds * 1e9):
        seen = yield VelocityStep(v, w)
    yield from stand(REST)
    phases.append(MotorPhase(kind, begin - 50_000_000, seen.now, left, right))


def _stairs(phases: list[MotorPhase], sign: float, drive: Drive) -> Manoeuvre[None]:
    """Turns on the spot, faster every half second, from next to nothing, until both wheels certainly turn."""
    seen = yield VelocityStep(
        say="slower than any wheel turns, then faster: " + ("to the left" if sign > 0 else "to the right")
    )
    begin, rim = seen.now, FINEST
    while rim <= LAST_STAIR:
        due = seen.now + round(STAIR_FOR * 1e9)
        while seen.now < due:
            seen = yield VelocityStep(*rim_speeds_of(-sign * rim, sign * rim, drive))
        if seen.odom is not None and abs(seen.odom.w) * drive.wheel_distance / 2 > 0.7 * rim > FINEST * 2:
            break
        rim *= 1.3
    phases.append(MotorPhase(PhaseKind.STAIRS, begin, seen.now, -sign, sign))
    yield from stand(REST)


def _stop(phases: list[MotorPhase], speed: float, drive: Drive, say: str) -> Manoeuvre[None]:
    """Drives at full speed, and presses STOP: then no ramp but the motors' own brakes it."""
    seen = yield from stand(0.5, say)
    assert seen.odom is not None
    cruise = line_to(Pose2(), stopping_room(drive, speed), speed, drive, seen.odom.odom_from_base)
    ask = next(cruise)
    reached: int | None = None
    while reached is None or seen.now < reached + round(CRUISE * 1e9):
        seen = yield ask
        try:
            ask = cruise.send(seen)
        except StopIteration:
            raise UserError(
                f"the robot does not reach {speed:g} m/s within {stopping_room(drive, speed):.1f} m",
                "clear the way, or choose a lower --speed",
            ) from None
        if reached is None and seen.odom is not None and seen.odom.v > 0.97 * speed:
            reached = seen.now
    begin = seen.now
    while seen.now < begin + round(STOPS_FOR * 1e9):
        seen = yield VelocityStep(stop=True)
    phases.append(MotorPhase(PhaseKind.STOP, begin, seen.now, speed, speed))
    yield from stand(REST)


def _about_turn(drive: Drive) -> Manoeuvre[None]:
    seen: StackState = yield from stand(0.2)
    assert seen.odom is not None
    yield from turn_to(pi, 1.0, drive, seen.odom.odom_from_base)
