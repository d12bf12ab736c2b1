# SPDX-License-Identifier: Apache-2.0
"""`zenav zones`. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import Command, MapName, RobotName, Stack, group

zones = group("Keep-out and speed zones on a map: where the robot may not be, or must be slow.")

ZoneName = Annotated[str, typer.Argument(help="A letter first; then letters, digits, - and _.")]


@zones.command("list", cls=Command)
def list_(
    active: Annotated[bool, typer.Option("--held", help="Those that the running stack keeps.")] = False,
    map_: MapName = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """List the zones: name, keep out or how fast, corners.

    Example: zenav zones list --map office
    """
    from zenav.client.zones import show_active, show_zones

    if active:
        show_active(robot, stack)
    else:
        show_zones(map_)


@zones.command(cls=Command)
def add(
    name: ZoneName,
    corners: Annotated[list[str], typer.Argument(metavar="X,Y...", help="m, m on the map; three or more, in order.")],
    speed: Annotated[float | None, typer.Option(help="m/s at most inside; without it: keep out.")] = None,
    percent: Annotated[float | None, typer.Option(help="Of the robot's top speed, instead.")] = None,
    map_: MapName = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Keep a zone beside the map; where the stack runs, it holds at once.

    Example: zenav zones add hall 0,4 8,4 8,7 0,7 --speed 0.3
    """
    from zenav.client.zones import add_zone, zone_of

    add_zone(robot, stack, name, zone_of(corners, speed, percent), map_)


@zones.command(cls=Command)
def remove(name: ZoneName, map_: MapName = "", robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Forget a zone, also where the stack runs.

    Example: zenav zones remove hall
    """
    from zenav.client.zones import remove_zone

    remove_zone(robot, stack, name, map_)


@zones.command(cls=Command)
def use(map_: MapName = "", robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Let the file's zones hold in the running stack, as loading its map does.

    Example: zenav zones use --map office
    """
    from zenav.client.zones import use_zones

    use_zones(robot, stack, map_)
