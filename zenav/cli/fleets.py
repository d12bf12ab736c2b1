# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet`: several robots. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import Command, Json, MapName, group

fleet = group("Several robots: see them all, stop them all, send one.")

Stacks = Annotated[
    list[str] | None,
    typer.Option(
        "--stack",
        metavar="STACK",
        envvar="ZENAV_STACK",
        help="Stack or router of robots; may be repeated. Without it: every stack on this computer.",
    ),
]


@fleet.command("list", cls=Command)
def list_(
    seconds: Annotated[float, typer.Option(min=0.5, max=3600, help="s to listen; the link is judged by them.")] = 2.0,
    watch: Annotated[bool, typer.Option("--watch", help="Again and again, until Ctrl-C.")] = False,
    as_json: Json = False,
    stack: Stacks = None,
) -> None:
    """List the robots: state, task, pose, map, battery (V), link, version, and where each one runs.

    Example: zenav fleet list --stack tcp/127.0.0.1:7447
    """
    from zenav.fleet.commands import list_robots

    raise typer.Exit(list_robots(stack or [], seconds, watch, as_json))


@fleet.command(cls=Command)
def stop(
    names: Annotated[list[str] | None, typer.Argument(help="Robots.", metavar="NAME...")] = None,
    every: Annotated[bool, typer.Option("--all", help="Every robot that is heard.")] = False,
    stack: Stacks = None,
) -> None:
    """Press STOP of robots, and wait until each confirms it. `zenav estop --release --name NAME` releases one.

    Example: zenav fleet stop --all
    """
    from zenav.fleet.commands import stop_robots

    raise typer.Exit(stop_robots(stack or [], names or [], every))


@fleet.command(cls=Command)
def goto(
    name: Annotated[str, typer.Argument(help="The robot.", metavar="NAME")],
    where: Annotated[
        list[str],
        typer.Argument(metavar="X Y [YAW] | PLACE", help="m, m on its map, degrees; without YAW any heading will do."),
    ],
    map_: MapName = "",
    stack: Stacks = None,
) -> None:
    """Send one robot to X Y on its map, or to a place by its name. Ctrl-C cancels the goal.

    Example: zenav fleet goto red kitchen
    """
    from zenav.fleet.commands import send_robot

    raise typer.Exit(send_robot(stack or [], name, where, map_))
