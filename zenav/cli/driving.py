# SPDX-License-Identifier: Apache-2.0
"""`zenav goto`, `route`, `explore`, `teleop` and what stops them. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import DRIVE, Command, MapName, RobotName, Stack, app

Tolerance = Annotated[
    float, typer.Option(min=0, max=5, help="m to a goal at which it is reached; 0: navigator.tolerance.")
]
HeadingTolerance = Annotated[
    float, typer.Option(min=0, max=180, help="Degrees to its heading; 0: navigator.yaw_tolerance.")
]
AnyHeading = Annotated[bool, typer.Option("--any-heading", help="Whatever heading a place has.")]


def _faults() -> list[str]:
    from services.sim.fault_requests import ALL_FAULTS

    return list(ALL_FAULTS)


@app.command(cls=Command, rich_help_panel=DRIVE)
def goto(
    where: Annotated[
        list[str],
        typer.Argument(metavar="X Y [YAW] | PLACE", help="m, m on the map, degrees; without YAW any heading will do."),
    ],
    tolerance: Tolerance = 0.0,
    heading_tolerance: HeadingTolerance = 0.0,
    any_heading: AnyHeading = False,
    map_: MapName = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Drive to X Y on the map, or to a place by its name, and stop. Ctrl-C cancels the goal.

    Example: zenav goto 3.5 -1.2 90 --tolerance 0.05
    """
    from zenav.client.navigation_client import ArrivalTolerance, drive_route
    from zenav.client.places import goal_from

    arrival = ArrivalTolerance(tolerance, heading_tolerance, any_heading)
    raise typer.Exit(drive_route(robot, stack, [goal_from(where, map_)], 0.0, 1, (), arrival))


@app.command(cls=Command, rich_help_panel=DRIVE)
def route(
    poses: Annotated[
        list[str] | None, typer.Argument(metavar="X,Y[,YAW][@S]|PLACE[@S]...", help="m, m, degrees; s to stay there.")
    ] = None,
    loops: Annotated[int, typer.Option(min=0, help="Rounds; 0 is for ever.")] = 1,
    dwell: Annotated[float, typer.Option(min=0, help="s to stand at each pose that has no stay of its own.")] = 0.0,
    pause: Annotated[bool, typer.Option("--pause", help="Stand, and keep the present task.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a paused task.")] = False,
    tolerance: Tolerance = 0.0,
    heading_tolerance: HeadingTolerance = 0.0,
    any_heading: AnyHeading = False,
    pass_through: Annotated[
        bool,
        typer.Option("--pass-through", help="Stop at the last pose only; no other heading counts."),
    ] = False,
    map_: MapName = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Drive through poses and places in order. Ctrl-C cancels the route.

    Example: zenav route 1,0 4,-2@10 kitchen --loops 3 --dwell 5
    """
    from zenav.client.navigation_client import ArrivalTolerance, drive_route, request_pause
    from zenav.client.places import dwell_times

    if pause or resume:
        raise typer.Exit(request_pause(robot, stack, pause and not resume))
    targets, stays = dwell_times(poses or [], dwell, map_)
    arrival = ArrivalTolerance(tolerance, heading_tolerance, any_heading, pass_through)
    raise typer.Exit(drive_route(robot, stack, targets, dwell, loops, stays, arrival))


@app.command(cls=Command, rich_help_panel=DRIVE)
def explore(
    others: Annotated[
        list[str] | None,
        typer.Option("--with", help="NAME or NAME@STACK of a robot that explores here too; repeat."),
    ] = None,
    origin: Annotated[
        tuple[float, float, float], typer.Option(metavar="X Y YAW", help="m, m, degrees of `map` in the common frame.")
    ] = (0.0, 0.0, 0.0),
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Explore until no reachable frontier is left. Ctrl-C cancels.

    Example: zenav explore --name red --with blue
    """
    from zenav.client.shared_exploring import explore

    raise typer.Exit(explore(robot, stack, others or [], origin))


@app.command(cls=Command, rich_help_panel=DRIVE)
def cancel(robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Drop the present task: the robot stands.

    Example: zenav cancel
    """
    from zenav.client.navigation_client import cancel

    raise typer.Exit(cancel(robot, stack))


@app.command(cls=Command, rich_help_panel=DRIVE)
def fault(
    name: Annotated[str, typer.Argument(help="What breaks; without it: what can.", autocompletion=_faults)] = "",
    seconds: Annotated[float, typer.Option(min=0, help="Duration, s; 0: until it is repaired.")] = 0.0,
    repair: Annotated[bool, typer.Option("--repair", "--mend", help="Repair it; without a name: all.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Break something of the simulated hardware: its messages, or bytes and ports (zenav up --hardware emulated).

    Example: zenav fault scan_nan --seconds 5
    """
    from zenav.client.fault import fault

    raise typer.Exit(fault(robot, stack, name, seconds, repair))


@app.command(cls=Command, rich_help_panel=DRIVE)
def teleop(
    speed: Annotated[float, typer.Option(min=0.01, max=5, help="m/s")] = 0.3,
    turn: Annotated[float, typer.Option(min=1, max=360, help="degrees/s")] = 45.0,
    override: Annotated[
        bool, typer.Option("--override", help="Creep through the guard's protective field: look where you drive.")
    ] = False,
    gamepad: Annotated[bool, typer.Option("--gamepad", help="Drive with a gamepad: hold a shoulder button.")] = False,
    device: Annotated[
        str, typer.Option(help="The gamepad's device; without it: the first gamepad.", metavar="/dev/input/eventN")
    ] = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Drive with the keyboard (w a s d or arrows, space stops, q quits), or with a gamepad.

    Example: zenav teleop --speed 0.2
    """
    from shared.config import UserError
    from zenav.client.teleop import teleop, teleop_gamepad

    if device and not gamepad:
        raise UserError("--device is of a gamepad", "add --gamepad")
    if gamepad and override:
        raise UserError("--override is for the keyboard", "leave one of both out")
    if gamepad:
        teleop_gamepad(robot, stack, speed, turn, device)
    else:
        teleop(robot, stack, speed, turn, override)


@app.command(cls=Command, rich_help_panel=DRIVE)
def estop(
    release: Annotated[bool, typer.Option("--release", help="Release it; that never moves the robot.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Press STOP: the robot stands until somebody releases it.

    Example: zenav estop --release
    """
    from zenav.client.navigation_client import estop

    raise typer.Exit(estop(robot, stack, not release))
