# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: on stdout, as comments of the YAML that follows, so that both can be pasted together."""

import sys
from collections.abc import Sequence
from math import degrees, isnan

from shared.config import Drive, Robot, UserError
from zenav.calibrate import laser, motor_response, motors, odometry
from zenav.calibrate.hand_eye import Intervals, Solution, residuals, turned_by
from zenav.calibrate.log import Log
from zenav.calibrate.odometry import BasePoses, Squares
from zenav.calibrate.rolling import Wheels


def tell(text: str) -> None:
    """A line of the report."""
    sys.stdout.write(f"# {text}".rstrip() + "\n")


def odometry_told(
    log: Log,
    robot: Robot,
    known: BasePoses | None,
    squares: Squares | None,
    solution: Solution | None,
    why_not: UserError | None,
) -> Wheels:
    """Writes the comparison, and returns the wheels to take: the scans', which use the whole way, else UMBmark's."""
    rolled, before = log.rolled, Wheels.of(robot.drive)
    columns: list[tuple[str, Wheels, tuple[float, float, float] | None]] = [("before", before, None)]
    if squares is not None:
        sigmas = squares.result.sigmas
        columns.append(("UMBmark", squares.result.wheels, (0.0, *sigmas) if sigmas else None))
        n = sum(run.clockwise for run in squares.runs)
        tell(f"{n} squares clockwise, {len(squares.runs) - n} counter-clockwise, {squares.result.side:.2f} m a side")
    if solution is not None:
        told = (solution.sigma_radius, solution.sigma_ratio, float(solution.sigmas[2]))
        columns.append(("scans", solution.wheels, told))
    elif why_not is not None:
        tell(f"not by the scans: {why_not.what}")
    tell(f"{'':26}" + "".join(f"{name:<22}" for name, _, _ in columns))
    for i, name in enumerate(("wheel_radius, m", "wheel_radius_ratio", "wheel_distance, m")):
        cells = []
        for _, wheels, sigma in columns:
            value = (wheels.radius, wheels.ratio, wheels.distance)[i]
            cells.append(f"{value:.5f}" + (f" +- {sigma[i]:.5f}" if sigma is not None and sigma[i] > 0 else ""))
        tell(f"{name:<26}" + "".join(f"{cell:<22}" for cell in cells))
    if squares is not None:
        cells = [f"{odometry.square_error(squares, rolled, wheels):.3f}" for _, wheels, _ in columns]
        tell(f"{'end of a square, m off':<26}" + "".join(f"{cell:<22}" for cell in cells))
    if known is not None and (first := odometry.drift(rolled, known, before)) is not None:
        drifts = [odometry.drift(rolled, known, wheels) or first for _, wheels, _ in columns]
        for name, texts in (
            (f"off by, over {odometry.WINDOW:g} m", [f"{1e2 * way:.2f} cm a metre" for way, _ in drifts]),
            ("", [f"{degrees(turn):.2f} degrees a metre" for _, turn in drifts]),
        ):
            tell(f"{name:<26}" + "".join(f"{text:<22}" for text in texts))
    if solution is not None:
        tell(f"slip: {solution.slip:.1e} m^2 a metre that a wheel rolls; odometry.wheel_variance stands for it")
    return columns[-1][1]


def laser_told(robot: Robot, found: Solution, pieces: Intervals) -> None:
    """The mount, how sure it is, and what it changes."""
    old = odometry.mount_of(robot)
    sx, sy, syaw = (float(s) for s in found.sigmas[3:])
    x, y, yaw = (float(v) for v in found.mount)
    tell(f"{len(pieces.begin)} pieces of the way, each by the scans and by the wheels")
    tell(f"laser {x:.4f} +- {sx:.4f} m ahead of the axis, {y:.4f} +- {sy:.4f} m to the left")
    tell(f"turned by {degrees(yaw):.2f} +- {degrees(syaw):.2f} degrees, {yaw:.5f} +- {syaw:.5f} rad")
    moved, turned = turned_by(found.mount, old)
    tell(f"that is {1e3 * moved:.1f} mm and {degrees(turned):.2f} degrees from the configured mount")
    way, turn = laser.rms(residuals(pieces, found.wheels, old))
    way_after, turn_after = laser.rms(found.residuals)
    tell(f"scans less wheels, a piece: {1e3 * way:.1f} mm, {degrees(turn):.2f} degrees before")
    tell(f"                            {1e3 * way_after:.1f} mm, {degrees(turn_after):.2f} degrees after")


def motors_told(
    drive: Drive,
    found: Sequence[motor_response.Turned],
    wrong: Sequence[tuple[str, str]],
    answers: Sequence[motor_response.Lag],
    stops: Sequence[motor_response.Braking],
    bands: dict[tuple[int, int], float],
) -> None:
    """What is wrong first, then what was measured."""
    for what, mend in wrong:
        tell(f"WRONG: {what}")
        tell(f"       {mend}")
    if not wrong:
        unseen = "" if all(t.seen is not None for t in found) else "; it is unknown whether both run backward"
        tell(f"directions: each wheel turns as asked, and its encoder counts with it{unseen}")
    for (wheel, sign), speed in sorted(bands.items()):
        way = "forward" if sign > 0 else "backward"
        told = "did not turn at all" if isnan(speed) else f"turns from {speed:.3f} m/s on"
        tell(f"dead band: the {motor_response.WHEELS[wheel]} wheel {told}, {way}")
    for name, answer in zip(motor_response.WHEELS, answers):
        tell(
            f"steps: the {name} wheel reaches {100 * answer.gain:.1f} %, dead time {1e3 * answer.delay:.0f} ms, "
            f"rises in {1e3 * answer.rise:.0f} ms (10 to 90 %), overshoots by {100 * answer.overshoot:.0f} %"
        )
        if answer.overshoot > 0.15:
            tell("       it swings: lower the board's proportional gain")
        elif abs(answer.steady_error) > 0.05:
            tell(f"       it stays {100 * answer.steady_error:+.0f} % off: raise the proportional or integral gain")
    for stop in stops:
        by_file = stop.speed**2 / (2 * drive.max_braking)
        tell(
            f"stop: from {stop.speed:.2f} m/s in {stop.seconds:.2f} s over {stop.distance:.3f} m, "
            f"{stop.deceleration:.2f} m/s^2; by max_braking {by_file:.3f} m"
        )
    if (braking := motors.reached(stops)) is not None:
        worst = max(stops, key=lambda s: s.distance)
        before, after = (worst.speed**2 / (2 * a) for a in (drive.max_braking, braking))
        tell(f"the longest stop, {worst.distance:.3f} m: {before:.3f} m by the file, {after:.3f} m by what is found")
