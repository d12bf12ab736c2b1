# SPDX-License-Identifier: Apache-2.0
"""`zenav calibrate`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from zenav.cli.parts import Command, RobotName, Stack, Write, Yes, group

calibrate = group("Measure the robot: wheels, laser, inertial sensor, motors. A report, a plot, and the YAML to paste.")


@calibrate.command("odometry", cls=Command)
def calibrate_odometry(
    recording: Annotated[
        Path | None, typer.Option(help="Of this drive; without it, squares are driven now.", metavar="FILE.mcap")
    ] = None,
    side: Annotated[float, typer.Option(min=0.5, max=20, help="m: the square's side.")] = 2.0,
    runs: Annotated[int, typer.Option(min=1, max=50, help="Squares each way round.")] = 5,
    measured: Annotated[bool, typer.Option("--measured", help="Type where each square ended, by a tape.")] = False,
    truth: Annotated[Literal["scans", "pose", "sim"], typer.Option(help="Source of the true poses.")] = "scans",
    method: Annotated[
        Literal["best", "umbmark", "scans"],
        typer.Option(help="umbmark: by the squares' ends; scans: by the whole way; best: scans where they suffice."),
    ] = "best",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    write: Write = False,
    yes: Yes = False,
) -> None:
    """Measure the wheels: their radius, its ratio right to left, and their distance (UMBmark: a square both ways).

    Example: zenav calibrate odometry --side 2 --runs 5
    """
    from zenav.calibrate.commands import calibrate_odometry

    raise typer.Exit(calibrate_odometry(robot, stack, recording, side, runs, measured, truth, method, write, yes))


@calibrate.command("laser", cls=Command)
def calibrate_laser(
    recording: Annotated[Path, typer.Argument(help="Of a drive with turns and straight ways.", metavar="FILE.mcap")],
    laser: Annotated[str, typer.Option(help="Its name in robot.lasers; without it: the first.", metavar="NAME")] = "",
    robot: RobotName = "x80sv",
    write: Write = False,
) -> None:
    """Measure where the laser sits and looks, from a recording of scan and base/wheels.

    Example: zenav calibrate laser recordings/x80.mcap
    """
    from zenav.calibrate.commands import calibrate_laser

    raise typer.Exit(calibrate_laser(robot, recording, laser, write))


@calibrate.command("imu", cls=Command)
def calibrate_imu(
    recording: Annotated[Path, typer.Argument(help="Of a drive with turns, starts and stops.", metavar="FILE.mcap")],
    robot: RobotName = "x80sv",
    write: Write = False,
) -> None:
    """Measure how the inertial sensor sits: the gyro's turns beside the scans', its direction by starts and stops.

    Example: zenav calibrate imu recordings/x80.mcap --robot turtlebot2
    """
    from zenav.calibrate.commands import calibrate_imu

    raise typer.Exit(calibrate_imu(robot, recording, write))


@calibrate.command("motors", cls=Command)
def calibrate_motors(
    blocks: Annotated[
        bool, typer.Option("--blocks", help="The wheels are in the air: no driving, no braking.")
    ] = False,
    speed: Annotated[
        float | None, typer.Option(min=0.1, max=5, help="m/s that it brakes from; without it, the robot's fastest.")
    ] = None,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    write: Write = False,
    yes: Yes = False,
) -> None:
    """Try the motors: directions, dead band, answer to steps, braking distance.

    Example: zenav calibrate motors --blocks
    """
    from zenav.calibrate.commands import calibrate_motors

    raise typer.Exit(calibrate_motors(robot, stack, blocks, speed, write, yes))
