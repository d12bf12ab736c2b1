# SPDX-License-Identifier: Apache-2.0
"""`zenav calibrate`: drives or reads a recording, computes, reports, plots, and writes the robot's file on request."""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from services.odometry.dead_reckoning import DeadReckoningConfig
from shared.config import Robot, Section, UserError, load_robot, nearest
from shared.geometry import wrapped
from shared.lasers import SCAN_TOPICS
from shared.ros_map import replace_file
from shared.types import Float64s
from zenav.calibrate import imu, motor_response, motors, odometry, report
from zenav.calibrate import laser as laser_
from zenav.calibrate.base_motion import BaseScales
from zenav.calibrate.hand_eye import HandEyeSolution, uncertain_values
from zenav.calibrate.log import CalibrationLog, read_calibration_log
from zenav.calibrate.manoeuvre import ready, square, stand, umbmark_drive
from zenav.calibrate.motor_test import motor_drive, stopping_room
from zenav.calibrate.odometry import BasePoses, Squares
from zenav.calibrate.robot_file import Values, values_of, write, yaml_snippet
from zenav.calibrate.scan_track import ScanTrack
from zenav.render.chart import Chart, charts_png

TURN_RATE = 1.0  # rad/s on the spot at most
SPEED = 0.3  # m/s of a square's sides


def calibrate_odometry(
    robot: str,
    stack: str,
    recording: Path | None,
    side: float,
    n_runs: int,
    measured: bool,
    source: str,
    method: str,
    writes: bool,
    yes: bool,
) -> int:
    """Wheel radii and distance, of a recording or of squares that are driven now."""
    known_robot = load_robot(robot).robot
    if known_robot.drive.kind == "velocity" and (measured or method == "umbmark"):
        raise UserError(
            f"{robot} is a velocity base: its wheels are calibrated in the base itself",
            "the scales of its own odometry are found by the scans: leave out --measured and --method umbmark",
        )
    ends: Float64s | None = None
    if recording is not None:
        log = read_calibration_log(recording, known_robot)
    else:
        log, ends = _driven_squares(known_robot, stack, side, n_runs, measured, yes)
    if known_robot.drive.kind == "velocity":
        return _calibrate_base(robot, known_robot, log, writes)
    solution, track, why_not = _solution(log, known_robot, method)
    truth: BasePoses | None = None
    if ends is None or solution is not None:
        mount = None if solution is None else solution.mount
        truth = odometry.truth(log, known_robot, source, track, mount)
    squares: Squares | None = None
    if method != "scans":
        try:
            squares = odometry.by_squares(log, known_robot, truth, ends)
        except UserError:
            if method == "umbmark" or solution is None:
                raise
    if solution is None and squares is None:
        raise why_not
    after = report.print_odometry(log, known_robot, truth, squares, solution, why_not if method != "umbmark" else None)
    values: Values = {
        "robot.drive.wheel_radius": round(after.radius, 5),
        "robot.drive.wheel_radius_ratio": round(after.ratio, 5),
        "robot.drive.wheel_distance": round(after.distance, 5),
    }
    if solution is None:
        values = {key: value for key, value in values.items() if key != "robot.drive.wheel_radius"}
    picture = odometry.charts(log, known_robot, truth, squares, after)
    return _write_results(robot, {"robot": known_robot}, values, picture, "odometry", writes)


def _calibrate_base(robot: str, known_robot: Robot, log: CalibrationLog, writes: bool) -> int:
    """The scales of a base that does its own odometry, by the scans."""
    solution, pieces, track = odometry.by_scans(log, known_robot)
    if open_ := [doubt for doubt in uncertain_values(solution) if doubt.startswith("wheel")]:
        raise UserError(open_[0], "record for longer, with more turns on the spot and more metres straight on")
    scales = BaseScales.of(solution, known_robot.drive)
    report.print_base(scales, pieces)
    values = {
        "odometry.base_distance_scale": round(scales.distance, 5),
        "odometry.base_turn_scale": round(scales.turn, 5),
    }
    before = {"odometry": load_robot(robot).section("odometry", DeadReckoningConfig)}
    truth = odometry.truth(log, known_robot, "scans", track, solution.mount)
    picture = odometry.charts(log, known_robot, truth, None, solution.wheels)
    return _write_results(robot, before, values, picture, "odometry", writes)


def calibrate_laser(robot: str, recording: Path, name: str, writes: bool) -> int:
    """The mount of a laser, of a recording. name: in `robot.lasers`; empty for the first one."""
    whole_robot = load_robot(robot).robot
    i_laser = _laser_place(whole_robot, name)
    known_robot = whole_robot.model_copy(update={"laser": whole_robot.all_lasers[i_laser], "lasers": ()})
    log = read_calibration_log(recording, known_robot, SCAN_TOPICS[i_laser])
    solution, pieces, _ = odometry.by_scans(log, known_robot)
    if open_ := [doubt for doubt in uncertain_values(solution) if doubt.startswith("mount")]:
        raise UserError(open_[0], "record for longer, with more turns on the spot and more metres straight on")
    report.print_laser(known_robot, solution, pieces)
    x, y, yaw = (float(v) for v in solution.mount)
    mount = ("robot.laser.mount", "robot.laser_2.mount")[i_laser]
    values = {
        f"{mount}.x": round(x, 4) + 0.0,  # no -0.0
        f"{mount}.y": round(y, 4) + 0.0,
        f"{mount}.yaw": round(yaw, 5) + 0.0,
    }
    picture = laser_.charts(log, known_robot, solution, pieces)
    return _write_results(robot, {"robot": whole_robot}, values, picture, "laser", writes)


def calibrate_imu(robot: str, recording: Path, writes: bool) -> int:
    """How the inertial sensor sits, of a recording with turns, starts and stops."""
    known_robot = load_robot(robot).robot
    if known_robot.imu is None:
        raise UserError(f"{robot} has no inertial sensor", "add `imu: {}` to its section `robot`")
    log = read_calibration_log(recording, known_robot)
    solution, pieces, _ = odometry.by_scans(log, known_robot)
    found = imu.solve(log.imus, pieces, log.rolled, solution.wheels)
    report.print_imu(found)
    if not found.has_right_axis:
        raise UserError("the gyro does not turn as the robot does", "is its z axis upright? see docs/hardware.md")
    values: dict[str, float | int] = {}
    if found.is_upside_down:
        values["robot.imu.upside_down"] = not known_robot.imu.upside_down
    elif found.yaw is not None:
        values["robot.imu.yaw"] = round(wrapped(known_robot.imu.yaw + found.yaw), 4) + 0.0  # no -0.0
    return _write_results(robot, {"robot": known_robot}, values, imu.charts(found), "imu", writes)


def _laser_place(robot: Robot, name: str) -> int:
    """Index of a laser in `robot.lasers`; 0 without a name. Raises UserError where there is none of this name."""
    names = tuple(laser.name for laser in robot.all_lasers)
    if name and name not in names:
        known = nearest(name, names) if any(names) else f"{robot.name} has one laser: leave out --laser"
        raise UserError(f"robot.lasers has no laser {name!r}", known)
    return names.index(name) if name else 0


def calibrate_motors(robot: str, stack: str, blocks: bool, speed: float | None, writes: bool, yes: bool) -> int:
    """Directions, dead band, step response and braking, driven now."""
    from zenav.calibrate.live import ManoeuvreRunner, confirm

    known_robot = _robot_with_wheels(robot)
    drive = known_robot.drive
    speed = min(speed or drive.max_speed, drive.max_speed)
    if blocks:
        what = "On blocks, wheels in the air: each wheel turns alone, then both, up to 0.2 m/s, for half a minute."
    else:
        what = (
            f"On free floor, {stopping_room(drive, speed):.1f} m ahead and 1 m around: the robot turns on the spot, "
            f"and drives {motor_stops()} times at {speed:g} m/s into STOP, to and fro; about a minute."
        )
    confirm(what, yes)
    with ManoeuvreRunner(known_robot, stack) as operator:
        phases = operator.perform(motor_drive(drive, blocks, speed))
        log = operator.log
    turns = motor_response.wheel_turns(log, phases, drive)
    if not blocks:
        turns = motors.by_motion(turns, log, phases, known_robot)
    elif sys.stdin.isatty():
        turns = motors.with_answers(turns, [ask_answers(t) for t in turns])
    answers = motor_response.lags(log, phases, drive)
    stops = motor_response.brakings(log, phases, drive)
    values: dict[str, float | int] = {}
    if motor_response.reversed_motors(turns):
        values["robot.drive.motor_direction"] = -drive.motor_direction
    if (braking := motors.reached_braking(stops)) is not None:
        values["robot.drive.max_braking"] = braking
    wrong = motor_response.directions(turns, drive)
    report.print_motors(drive, turns, wrong, answers, stops, motor_response.dead_band(log, phases, drive))
    picture = motors.charts(log, phases, known_robot, answers)
    _write_results(robot, {"robot": known_robot}, values, picture, "motors", writes)
    return 1 if wrong else 0


def motor_stops() -> int:
    """How often STOP is tried."""
    from zenav.calibrate.motor_test import N_STOPS

    return N_STOPS


def _robot_with_wheels(robot: str) -> Robot:
    """The robot of a file. Raises UserError for a base that controls its own speed: it reports no wheels."""
    known_robot = load_robot(robot).robot
    if known_robot.drive.kind == "velocity":
        raise UserError(
            f"{robot} is a velocity base: its wheels are calibrated in the base itself",
            "its odometry and its laser can be calibrated: zenav calibrate odometry, zenav calibrate laser",
        )
    return known_robot


def _driven_squares(
    robot: Robot, stack: str, side: float, n_runs: int, measured: bool, yes: bool
) -> tuple[CalibrationLog, Float64s | None]:
    """The log of squares that are driven now, and their ends where people measure them."""
    from zenav.calibrate.live import ManoeuvreRunner, confirm

    if measured and not sys.stdin.isatty():
        raise UserError("--measured needs somebody to type what was measured", "run it in a terminal, or leave it out")
    drive, speed = robot.drive, min(SPEED, robot.drive.max_speed)
    rate = min(TURN_RATE, drive.max_turn_rate / 2)
    minutes = 2 * n_runs * (4 * side / speed + 25) / 60
    confirm(
        f"The robot drives a square of {side:g} m {n_runs} times each way round, about {minutes:.0f} minutes.\n"
        f"It needs free floor: {side + 0.5:g} m ahead, and as much to its left and to its right.",
        yes,
    )
    with ManoeuvreRunner(robot, stack) as operator:
        if not measured:
            operator.perform(umbmark_drive(side, n_runs, speed, rate, drive, again=True))
            return operator.log, None
        ends = []
        for i in range(2 * n_runs):
            _line("Put the robot on its mark, its heading along the first side. Enter when it stands: ")
            operator.perform(stand(1.5, f"square {i + 1} of {2 * n_runs}"))
            operator.perform(square(side, i % 2 == 0, speed, rate, drive))
            operator.perform(stand(1.5))
            ends.append(read_end_pose())
        operator.perform(ready())
        return operator.log, np.array(ends)


def _solution(
    log: CalibrationLog, robot: Robot, method: str
) -> tuple[HandEyeSolution | None, ScanTrack | None, UserError]:
    """(solution, track of the scans, error to raise where no other method has a solution); None where the scans fail.

    Raises UserError where `method` is "scans" and has no certain solution.
    """
    nothing = UserError("no method was tried", "take --method best")
    if method == "umbmark":
        return None, None, nothing
    try:
        solution, _, track = odometry.by_scans(log, robot)
    except UserError as error:
        if method == "scans":
            raise
        return None, None, error
    open_ = [doubt for doubt in uncertain_values(solution) if doubt.startswith("wheel")]
    if not open_:
        return solution, track, nothing
    unsure = UserError(open_[0], "record for longer, with more turns on the spot and more metres straight on")
    if method == "scans":
        raise unsure
    return None, track, unsure


def _write_results(
    robot: str, before: Mapping[str, Section], values: Values, charts: list[Chart], name: str, writes: bool
) -> int:
    """Writes the plot, the YAML, and the robot's file where it is wanted."""
    from zenav.console.run_folder import new_run_folder

    place = new_run_folder("calibrate") / f"{name}.png"
    replace_file(place, charts_png(charts))
    report.print_line(f"plot: {place}")
    robot_section = before.get("robot")
    lasers = robot_section.lasers if isinstance(robot_section, Robot) else ()
    sys.stdout.write(yaml_snippet(values, values_of(before, values), tuple(laser.name for laser in lasers)))
    if writes and values:
        path = write(robot, values)
        sys.stderr.write(f"{path} is written; restart the stack to use it\n")
    return 0


def ask_answers(turned: motor_response.WheelTurn) -> str:
    """What people saw turn, as a key of motors.KEYS, or nothing."""
    direction = "forward" if turned.asked > 0 else "backward"
    while True:
        answer = _line(
            f"'the {motor_response.WHEELS[turned.wheel]} wheel alone, {direction}': what turned? "
            "Enter: just that; lf, lb, rf, rb: left or right, forward or backward; -: nothing: "
        ).lower()
        if not answer or answer in motors.KEYS:
            return answer


def read_end_pose() -> tuple[float, float]:
    """Where the robot ended, as measured with a tape."""
    while True:
        parts = _line("Where is it now, from the mark? X Y in m, X along the first side, Y to its left: ").split()
        try:
            x, y = (float(part.rstrip(",")) for part in parts)
        except ValueError:
            continue
        if max(abs(x), abs(y)) < 5:
            return x, y


def _line(prompt: str) -> str:
    sys.stderr.write(prompt)
    sys.stderr.flush()
    line = sys.stdin.readline()
    if not line:
        raise UserError("the input has ended", "run it in a terminal")
    return line.strip()
