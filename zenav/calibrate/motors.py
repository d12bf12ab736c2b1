# SPDX-License-Identifier: Apache-2.0
"""`zenav calibrate motors`: which wheel turned, how hard the base brakes, and the curves of both."""

from collections.abc import Sequence
from dataclasses import replace
from math import floor

import numpy as np

from shared.config import Robot, UserError
from zenav.calibrate.log import CalibrationLog
from zenav.calibrate.motor_response import (
    GRID,
    BrakingRun,
    FirstOrderLag,
    Wheel,
    WheelTurn,
    first_order,
    rim_speeds,
    rims_asked,
    wheel_of_motion,
)
from zenav.calibrate.motor_test import MotorPhase, PhaseKind
from zenav.calibrate.odometry import truth
from zenav.calibrate.rolling import relative_poses
from zenav.render.chart import AFTER, BEFORE, OTHER, TRUE, Chart

KEYS: dict[str, Wheel | None] = {"lf": (0, 1), "lb": (0, -1), "rf": (1, 1), "rb": (1, -1), "-": None}
FINEST = 0.05  # m/s^2 to which the braking is rounded, downward


def by_motion(
    turns: Sequence[WheelTurn], log: CalibrationLog, phases: Sequence[MotorPhase], robot: Robot
) -> list[WheelTurn]:
    """`turns`, each with the wheel that turned according to the scans; unchanged where they do not determine it."""
    alone = [p for p in phases if p.kind is PhaseKind.ALONE]
    if not alone:
        return list(turns)
    part = log.during(alone[0].begin - 1_000_000_000, alone[-1].end + 1_000_000_000)
    # the encoders are what is tested: the scans are placed without them
    still = [replace(state, left=0.0, right=0.0) for state in part.wheels]
    try:
        track = truth(replace(part, wheels=still), robot, "scans", None)
    except UserError:
        return list(turns)
    corrected = []
    for turned, phase in zip(turns, alone):
        i, j = np.searchsorted(track.stamps, (phase.begin, phase.end))
        if i >= len(track.stamps) or j >= len(track.stamps):
            corrected.append(turned)
            continue
        forward, _, turn = relative_poses(track.poses[i : i + 1], track.poses[j : j + 1])[0]
        # along the arc, not its chord
        forward_arc = float(forward / np.sinc(turn / np.pi)) if abs(turn) < 2 else float(forward)
        distance = robot.drive.wheel_distance
        corrected.append(replace(turned, seen=wheel_of_motion(forward_arc, float(turn), turned.asked, distance)))
    return corrected


def with_answers(turns: Sequence[WheelTurn], answers: Sequence[str]) -> list[WheelTurn]:
    """With what people saw: `lf`, `lb`, `rf`, `rb`, `-`, or nothing for: as asked."""
    return [replace(t, seen=KEYS[a] if a else t.commanded) for t, a in zip(turns, answers)]


def reached_braking(stops: Sequence[BrakingRun]) -> float | None:
    """m/s^2 that the base reached in every stop, rounded down; None where none was measured."""
    if not stops:
        return None
    return max(round(floor(min(s.deceleration for s in stops) / FINEST) * FINEST, 2), FINEST)


def charts(
    log: CalibrationLog, phases: Sequence[MotorPhase], robot: Robot, answers: Sequence[FirstOrderLag]
) -> list[Chart]:
    """The steps with the fitted answer; and the stops, or the dead band's stairs where there are none."""
    rolled, drive = log.rolled, robot.drive
    step = Chart("Steps, on the spot: the right wheel", "s", "m/s at the rim")
    begin = 0.0
    for phase in (p for p in phases if p.kind is PhaseKind.STEP):
        times = np.arange(phase.begin - 200_000_000, phase.end + 500_000_000, round(GRID * 1e9))
        seconds = begin + (times - times[0]) * 1e-9
        asked = rims_asked(log.motors, times, drive)[:, 1]
        step.line(seconds, asked, OTHER, "asked")
        step.line(seconds, rim_speeds(rolled, times, drive)[:, 1], AFTER, "measured")
        if answers:
            fit = answers[1]
            step.line(seconds, first_order(asked, fit.gain, fit.delay, fit.lag), TRUE, "fitted")
        begin = float(seconds[-1]) + 0.3
    stops = [p for p in phases if p.kind is PhaseKind.STOP]
    if stops:
        brake = Chart("Stops by STOP", "s since STOP", "m/s")
        for phase in stops:
            times = np.arange(phase.begin - 300_000_000, phase.end, 10_000_000)
            seconds = (times - phase.begin) * 1e-9
            brake.line(seconds, rims_asked(log.motors, times, drive).mean(axis=1), OTHER, "asked")
            brake.line(seconds, rim_speeds(rolled, times, drive).mean(axis=1), BEFORE, "measured")
        return [step, brake]
    stairs = Chart("Slower than any wheel turns, then faster: the right wheel", "s", "m/s at the rim")
    for phase in (p for p in phases if p.kind is PhaseKind.STAIRS):
        times = np.arange(phase.begin, phase.end, 20_000_000)
        seconds = (times - phase.begin) * 1e-9
        stairs.line(seconds, rims_asked(log.motors, times, drive)[:, 1], OTHER, "asked")
        stairs.line(seconds, rim_speeds(rolled, times, drive, 0.2)[:, 1], AFTER, "measured")
    return [step, stairs]
