# SPDX-License-Identifier: Apache-2.0
"""What did the wheels do with their commands? Directions, dead band, delay, lag, overshoot, and how hard they brake.

Speeds are m/s at the rim by the configured radii, forward positive; of the encoders, not of the floor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, floor, pi

import numpy as np

from shared.config import Drive, UserError
from shared.messages import MotorCommand
from shared.types import Float64s, Int64s
from zenav.calibrate.log import CalibrationLog
from zenav.calibrate.motor_test import MotorPhase, PhaseKind
from zenav.calibrate.rolling import WheelTravel

WHEELS = ("left", "right")
TURNS = 0.25  # of what was asked for: less is no turning
GRID = 0.005  # s
MAX_DELAY_S = 0.4
STOPPED = 0.01  # m/s
SETTLED = 0.5  # s at the end of a step that its steady speed is taken from


Wheel = tuple[int, int]
"""Which wheel turned (0 left, 1 right), and which way (1 forward, -1 backward)."""


@dataclass(frozen=True, slots=True)
class WheelTurn:
    """A wheel that was commanded to turn alone. asked, left, right: m at the rims, by the command and by the encoders.

    seen: the wheel that really turned, by the scans or by the operator; None where it is unknown.
    """

    wheel: int
    asked: float
    left: float
    right: float
    seen: Wheel | None = None

    @property
    def commanded(self) -> Wheel:
        return self.wheel, 1 if self.asked > 0 else -1

    @property
    def counted(self) -> Wheel | None:
        """The wheel whose encoder counted; None where none did."""
        return faster_wheel(self.left, self.right, self.asked)


def faster_wheel(left: float, right: float, asked: float) -> Wheel | None:
    """The wheel that turned more, of the ways (m) of both; None where neither turned as if it had been asked to."""
    distances = (left, right)
    i = int(np.argmax(np.abs(distances)))
    return (i, 1 if distances[i] > 0 else -1) if abs(distances[i]) > TURNS * abs(asked) else None


def wheel_of_motion(forward: float, turn: float, asked: float, distance: float) -> Wheel | None:
    """The wheel that moved the base by `forward` m and `turn` rad: a wheel alone swings it around the other one."""
    return faster_wheel(forward - turn * distance / 2, forward + turn * distance / 2, asked)


@dataclass(frozen=True, slots=True)
class FirstOrderLag:
    """A wheel's answer: m/s out for m/s in, dead time and time constant (s), overshoot and steady error (shares)."""

    gain: float
    delay: float
    lag: float
    overshoot: float
    steady_error: float

    @property
    def rise(self) -> float:
        """s from 10 to 90 % of a step"""
        return float(np.log(9.0)) * self.lag


@dataclass(frozen=True, slots=True)
class BrakingRun:
    """A stop by STOP: from which speed (m/s), over which distance (m) and time (s) since the motors' first zero."""

    speed: float
    distance: float
    seconds: float

    @property
    def deceleration(self) -> float:
        """m/s^2 of an even braking over the same distance: delay and lag are in it."""
        return self.speed**2 / (2 * self.distance) if self.distance > 0 else float("inf")


def wheel_turns(log: CalibrationLog, phases: Sequence[MotorPhase], drive: Drive) -> list[WheelTurn]:
    """What each wheel did when it was asked to turn alone, by the encoders."""
    rolled, turns = log.rolled, []
    for phase in (p for p in phases if p.kind is PhaseKind.ALONE):
        left, right = rolled.at(np.array([phase.begin, phase.end + 500_000_000], np.int64))
        wheel = 0 if phase.left else 1
        seconds = (phase.end - phase.begin) * 1e-9
        asked = (phase.left, phase.right)[wheel] * seconds
        turns.append(
            WheelTurn(wheel, asked, float(left[1] - left[0]) * drive.left_radius,
                   float(right[1] - right[0]) * drive.right_radius)
        )  # fmt: skip
    return turns


def directions(turns: Sequence[WheelTurn], drive: Drive) -> list[tuple[str, str]]:
    """Errors of motors and encoders, each with its hint; empty where there is none."""
    wrong: list[tuple[str, str]] = []
    if turns and all(t.counted is not None and t.counted[0] != t.wheel for t in turns):
        error = "the encoders are exchanged: one counts when the other wheel is asked to turn"
        wrong.append(
            (error, "exchange the encoders' plugs; if the robot also turns the wrong way, the motors' instead")
        )
    else:
        for t in turns:
            name, direction = WHEELS[t.wheel], "forward" if t.asked > 0 else "backward"
            if t.counted is None:
                error = f"the {name} wheel does not turn {direction}, or its encoder does not count"
                wrong.append((error, "check its motor, its encoder and their plugs"))
            elif t.counted == (t.wheel, -t.commanded[1]):
                wrong.append((f"the {name} encoder counts against its motor", "exchange its channels A and B"))
    seen_and_commanded = [(t.seen, t.commanded) for t in turns if t.seen is not None]
    if seen_and_commanded and all(seen == (wheel, -sign) for seen, (wheel, sign) in seen_and_commanded):
        error = "the robot drives backward when it is asked to drive forward"
        wrong.append((error, f"set robot.drive.motor_direction: {-drive.motor_direction}"))
    elif seen_and_commanded and all(seen[0] != wheel for seen, (wheel, _) in seen_and_commanded):
        same = all(seen[1] == sign for seen, (_, sign) in seen_and_commanded)
        error = "the motors are exchanged" + ("" if same else ", and run backward")
        wrong.append((error, "exchange the motors' plugs, and the encoders'" + ("" if same else "; then try again")))
    else:
        for seen, (wheel, sign) in seen_and_commanded:
            if seen == (wheel, -sign):
                wrong.append((f"the {WHEELS[wheel]} motor runs backward", "exchange the two wires of this motor"))
    return list(dict.fromkeys(wrong))


def reversed_motors(turns: Sequence[WheelTurn]) -> bool:
    """Whether both wheels turn the other way, and their encoders with them: a matter of the sign alone."""
    return bool(turns) and all(t.seen == (t.wheel, -t.commanded[1]) and t.counted == t.commanded for t in turns)


def dead_band(log: CalibrationLog, phases: Sequence[MotorPhase], drive: Drive) -> dict[tuple[int, int], float]:
    """(wheel, sign) -> m/s at the rim, the smallest command that turned it; nan where none did."""
    rolled, bands = log.rolled, {}
    count = 2 * pi / drive.counts_per_turn
    for phase in (p for p in phases if p.kind is PhaseKind.STAIRS):
        stamps = np.arange(phase.begin, phase.end + 100_000_000, 20_000_000)
        command = rims_asked(log.motors, stamps - 100_000_000, drive)
        for wheel, angles in enumerate(rolled.at(stamps)):
            sign = 1 if (phase.left, phase.right)[wheel] > 0 else -1
            moving = np.flatnonzero(sign * (angles - angles[0]) >= 1.5 * count)
            bands[(wheel, sign)] = abs(float(command[moving[0], wheel])) if len(moving) else float("nan")
    return bands


def rims_asked(motors: Sequence[MotorCommand], stamps: Int64s, drive: Drive) -> Float64s:
    """(n, 2) m/s at the rims that the board was asked for at times (ns): the last command before each."""
    if not motors:
        raise UserError("there are no motor commands", "is base_driver running? zenav topic hz hardware/motors")
    scale = drive.motor_direction * 2 * pi / drive.counts_per_turn
    rows = np.array([(-m.left * scale * drive.left_radius, m.right * scale * drive.right_radius) for m in motors])
    index = np.searchsorted(np.array([m.stamp for m in motors], np.int64), stamps, "right") - 1
    return np.asarray(np.where(index[:, None] >= 0, rows[np.maximum(index, 0)], 0.0))


def rim_speeds(rolled: WheelTravel, stamps: Int64s, drive: Drive, window: float = 0.06) -> Float64s:
    """(n, 2) m/s at the rims by the encoders around times (ns), over `window` s."""
    half = round(window * 5e8)
    after, before = rolled.at(stamps + half), rolled.at(stamps - half)
    radii = (drive.left_radius, drive.right_radius)
    return np.column_stack([(a - b) * r / window for a, b, r in zip(after, before, radii)])


def lags(log: CalibrationLog, phases: Sequence[MotorPhase], drive: Drive) -> list[FirstOrderLag]:
    """Each wheel's answer to all steps: gain, dead time and lag of first order, by least squares."""
    from scipy.optimize import least_squares

    steps = [p for p in phases if p.kind is PhaseKind.STEP]
    if not steps:
        return []
    rolled, fitted = log.rolled, []
    for wheel in (0, 1):
        parts = []
        for phase in steps:
            times = np.arange(phase.begin - 200_000_000, phase.end + 500_000_000, round(GRID * 1e9))
            parts.append((rims_asked(log.motors, times, drive)[:, wheel], rim_speeds(rolled, times, drive)[:, wheel]))

        def off(p: Float64s, parts: list[tuple[Float64s, Float64s]] = parts) -> Float64s:
            return np.concatenate([first_order(asked, p[0], p[1], p[2]) - seen for asked, seen in parts])

        bounds = ([0.0, 0.0, 0.001], [3.0, MAX_DELAY_S, 2.0])
        starts = [(1.0, delay, 0.1) for delay in (0.02, 0.1, 0.2)]
        fits = [least_squares(off, s, bounds=bounds, x_scale=(1, 0.05, 0.05), diff_step=1e-3) for s in starts]
        gain, delay, lag = min(fits, key=lambda fit: fit.cost).x
        overshoots, errors = zip(*(_steady_state(rolled, phase, wheel, drive) for phase in steps))
        fitted.append(FirstOrderLag(float(gain), float(delay), float(lag), max(overshoots), float(np.mean(errors))))
    return fitted


def first_order(asked: Float64s, gain: float, delay: float, lag: float) -> Float64s:
    """(n,) the answer of a first-order lag with dead time to a command (n,), GRID s apart."""
    whole = floor(delay / GRID)
    share = delay / GRID - whole
    late = np.concatenate((np.full(whole + 1, asked[0]), asked))
    late = (1 - share) * late[1 : len(asked) + 1] + share * late[: len(asked)]
    keep = exp(-GRID / lag)
    from scipy.linalg import solve_banded

    pushed = gain * (1 - keep) * late  # answer[i] - keep * answer[i - 1]
    pushed[0] += keep * gain * asked[0]
    ones, kept = np.ones(len(late)), np.full(len(late), -keep)
    return np.asarray(solve_banded((1, 0), np.stack((ones, kept)), pushed))


def _steady_state(rolled: WheelTravel, phase: MotorPhase, wheel: int, drive: Drive) -> tuple[float, float]:
    """Overshoot and steady error of one step, as shares of what was asked for."""
    asked = (phase.left, phase.right)[wheel]
    radius = (drive.left_radius, drive.right_radius)[wheel]
    times = np.arange(phase.begin, phase.end, 20_000_000)
    speeds = rim_speeds(rolled, times, drive, 0.1)[:, wheel] / asked
    ends = rolled.at(np.array([phase.end - round(SETTLED * 1e9), phase.end], np.int64))[wheel]
    steady = float(ends[1] - ends[0]) * radius / SETTLED / asked
    count = 2 * pi / drive.counts_per_turn * radius / 0.1 / abs(asked)  # what one encoder count more looks like
    return max(float(speeds.max()) - steady - count, 0.0), steady - 1.0


def brakings(log: CalibrationLog, phases: Sequence[MotorPhase], drive: Drive) -> list[BrakingRun]:
    """Each stop, from the motors' first zero to standstill."""
    rolled, runs = log.rolled, []
    for phase in (p for p in phases if p.kind is PhaseKind.STOP):
        zero = next((m.stamp for m in log.motors if m.stamp >= phase.begin and not (m.left or m.right)), None)
        if zero is None:
            continue
        times = np.arange(zero, phase.end, 10_000_000)
        speed = float(rim_speeds(rolled, np.array([zero - 100_000_000], np.int64), drive, 0.2).mean())
        now = np.abs(rim_speeds(rolled, times, drive)).max(axis=1)
        stands = np.flatnonzero(now < STOPPED)
        if not len(stands) or speed < 0.05:
            continue
        left, right = rolled.at(np.array([zero, phase.end], np.int64))
        distance = ((left[1] - left[0]) * drive.left_radius + (right[1] - right[0]) * drive.right_radius) / 2
        runs.append(BrakingRun(speed, float(distance), float(times[stands[0]] - zero) * 1e-9))
    return runs
