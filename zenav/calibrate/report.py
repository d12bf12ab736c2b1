# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: on stdout, as comments of the YAML that follows, so that both can be pasted together."""

import sys
from collections.abc import Sequence
from math import degrees, isnan

from shared.config import Drive, Robot, UserError
from zenav.calibrate import laser, motor_response, motors, odometry
from zenav.calibrate.base_motion import BaseScales
from zenav.calibrate.hand_eye import HandEyeSolution, MotionIntervals, mount_difference, residuals
from zenav.calibrate.imu import ImuSolution
from zenav.calibrate.log import CalibrationLog
from zenav.calibrate.odometry import BasePoses, Squares
from zenav.calibrate.rolling import WheelGeometry

MAX_BEND_RAD = 0.01  # rad a metre, that a straight drive of the base may turn unsaid


def print_line(text: str) -> None:
    """A line of the report."""
    sys.stdout.write(f"# {text}".rstrip() + "\n")


def print_odometry(
    log: CalibrationLog,
    robot: Robot,
    track: BasePoses | None,
    squares: Squares | None,
    solution: HandEyeSolution | None,
    why_not: UserError | None,
) -> WheelGeometry:
    """Writes the comparison, and returns the wheels to take: the scans', which use the whole way, else UMBmark's."""
    rolled, before = log.rolled, WheelGeometry.of(robot.drive)
    columns: list[tuple[str, WheelGeometry, tuple[float, float, float] | None]] = [("before", before, None)]
    if squares is not None:
        sigmas = squares.result.sigmas
        columns.append(("UMBmark", squares.result.wheels, (0.0, *sigmas) if sigmas else None))
        n = sum(run.clockwise for run in squares.runs)
        print_line(
            f"{n} squares clockwise, {len(squares.runs) - n} counter-clockwise, {squares.result.side:.2f} m a side"
        )
    if solution is not None:
        sigmas_of_scans = (solution.sigma_radius, solution.sigma_ratio, float(solution.sigmas[2]))
        columns.append(("scans", solution.wheels, sigmas_of_scans))
    elif why_not is not None:
        print_line(f"not by the scans: {why_not.what}")
    print_line(f"{'':26}" + "".join(f"{name:<22}" for name, _, _ in columns))
    for i, name in enumerate(("wheel_radius, m", "wheel_radius_ratio", "wheel_distance, m")):
        cells = []
        for _, wheels, sigma in columns:
            value = (wheels.radius, wheels.ratio, wheels.distance)[i]
            cells.append(f"{value:.5f}" + (f" +- {sigma[i]:.5f}" if sigma is not None and sigma[i] > 0 else ""))
        print_line(f"{name:<26}" + "".join(f"{cell:<22}" for cell in cells))
    if squares is not None:
        cells = [f"{odometry.square_error(squares, rolled, wheels):.3f}" for _, wheels, _ in columns]
        print_line(f"{'end of a square, m off':<26}" + "".join(f"{cell:<22}" for cell in cells))
    if track is not None and (first := odometry.drift(rolled, track, before)) is not None:
        drifts = [odometry.drift(rolled, track, wheels) or first for _, wheels, _ in columns]
        for name, texts in (
            (f"off by, over {odometry.WINDOW:g} m", [f"{1e2 * drift:.2f} cm a metre" for drift, _ in drifts]),
            ("", [f"{degrees(turn):.2f} degrees a metre" for _, turn in drifts]),
        ):
            print_line(f"{name:<26}" + "".join(f"{text:<22}" for text in texts))
    if solution is not None:
        print_line(f"slip: {solution.slip:.1e} m^2 a metre that a wheel rolls, the value of odometry.wheel_variance")
    return columns[-1][1]


def print_base(scales: BaseScales, pieces: MotionIntervals) -> None:
    """The scales of a base that does its own odometry, and what they cannot correct."""
    print_line(f"{len(pieces.begin)} pieces of the way, each by the scans and by the base")
    print_line(f"distance: {scales.distance:.5f} +- {scales.sigma_distance:.5f} of what the base reports")
    print_line(f"turn:     {scales.turn:.5f} +- {scales.sigma_turn:.5f} of what the base reports")
    if abs(scales.bend) > MAX_BEND_RAD:
        print_line(
            f"it turns by {degrees(scales.bend):.2f} degrees in a metre that it reports as straight: "
            "calibrate its wheels in the base itself"
        )


def print_laser(robot: Robot, solution: HandEyeSolution, pieces: MotionIntervals) -> None:
    """The mount, how sure it is, and what it changes."""
    old = odometry.mount_of(robot)
    sx, sy, syaw = (float(s) for s in solution.sigmas[3:])
    x, y, yaw = (float(v) for v in solution.mount)
    print_line(f"{len(pieces.begin)} pieces of the way, each by the scans and by the wheels")
    print_line(f"laser {x:.4f} +- {sx:.4f} m ahead of the axis, {y:.4f} +- {sy:.4f} m to the left")
    print_line(f"turned by {degrees(yaw):.2f} +- {degrees(syaw):.2f} degrees, {yaw:.5f} +- {syaw:.5f} rad")
    moved, turned = mount_difference(solution.mount, old)
    print_line(f"that is {1e3 * moved:.1f} mm and {degrees(turned):.2f} degrees from the configured mount")
    distance, turn = laser.rms(residuals(pieces, solution.wheels, old))
    distance_after, turn_after = laser.rms(solution.residuals)
    print_line(f"scans less wheels, a piece: {1e3 * distance:.1f} mm, {degrees(turn):.2f} degrees before")
    print_line(f"                            {1e3 * distance_after:.1f} mm, {degrees(turn_after):.2f} degrees after")


def print_imu(solution: ImuSolution) -> None:
    """The gyro beside the scans, and the direction of the sensor."""
    print_line(f"{len(solution.scans)} pieces of the way, each by the scans and by the gyro")
    print_line(f"the gyro reads {solution.scale:.4f} +- {solution.sigma_scale:.4f} of a turn")
    print_line(f"its bias is {degrees(solution.bias):.3f} degrees/s, which odometry measures at each standstill")
    if solution.is_upside_down:
        print_line("it reads turns the other way round: after the change, record again for its direction")
    elif solution.yaw is None:
        print_line("the robot accelerated too little for the direction of the sensor, which no service needs")
    else:
        off, sigma = degrees(solution.yaw), degrees(solution.sigma_yaw)
        print_line(f"it is turned by {off:.1f} +- {sigma:.1f} degrees against the configured direction")


def print_motors(
    drive: Drive,
    turns: Sequence[motor_response.WheelTurn],
    wrong: Sequence[tuple[str, str]],
    answers: Sequence[motor_response.FirstOrderLag],
    stops: Sequence[motor_response.BrakingRun],
    bands: dict[tuple[int, int], float],
) -> None:
    """What is wrong first, then what was measured."""
    for what, hint in wrong:
        print_line(f"WRONG: {what}")
        print_line(f"       {hint}")
    if not wrong:
        unseen = "" if all(t.seen is not None for t in turns) else "; it is unknown whether both run backward"
        print_line(f"directions: each wheel turns as asked, and its encoder counts with it{unseen}")
    for (wheel, sign), speed in sorted(bands.items()):
        direction = "forward" if sign > 0 else "backward"
        response = "did not turn at all" if isnan(speed) else f"turns from {speed:.3f} m/s on"
        print_line(f"dead band: the {motor_response.WHEELS[wheel]} wheel {response}, {direction}")
    for name, answer in zip(motor_response.WHEELS, answers):
        print_line(
            f"steps: the {name} wheel reaches {100 * answer.gain:.1f} %, dead time {1e3 * answer.delay:.0f} ms, "
            f"rises in {1e3 * answer.rise:.0f} ms (10 to 90 %), overshoots by {100 * answer.overshoot:.0f} %"
        )
        if answer.overshoot > 0.15:
            print_line("       it swings: lower the board's proportional gain")
        elif abs(answer.steady_error) > 0.05:
            print_line(
                f"       it stays {100 * answer.steady_error:+.0f} % off: raise the proportional or integral gain"
            )
    for stop in stops:
        by_file = stop.speed**2 / (2 * drive.max_braking)
        print_line(
            f"stop: from {stop.speed:.2f} m/s in {stop.seconds:.2f} s over {stop.distance:.3f} m, "
            f"{stop.deceleration:.2f} m/s^2; by max_braking {by_file:.3f} m"
        )
    if (braking := motors.reached_braking(stops)) is not None:
        worst = max(stops, key=lambda s: s.distance)
        before, after = (worst.speed**2 / (2 * a) for a in (drive.max_braking, braking))
        print_line(
            f"the longest stop, {worst.distance:.3f} m: {before:.3f} m by the file, {after:.3f} m by what is found"
        )
