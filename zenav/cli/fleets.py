# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet`: several robots. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.parts import Command, Json, MapName, group

fleet = group("Several robots: see them all, stop them all, send one, give them tasks.")
task = group("The queue of tasks that zenav fleet dispatch gives to robots.")
fleet.add_typer(task, name="task")

Queue = Annotated[
    Path, typer.Option("--queue", metavar="FILE", envvar="ZENAV_QUEUE", help="The file with the tasks, an SQLite one.")
]

Stacks = Annotated[
    list[str] | None,
    typer.Option(
        "--stack",
        metavar="STACK",
        envvar="ZENAV_STACK",
        help="Stack or router of robots; may be repeated. Without it: every stack on this computer.",
    ),
]


Robot = Annotated[str, typer.Argument(help="The robot.", metavar="NAME")]
Site = Annotated[str, typer.Option("--stack", metavar="STACK", help="The router of the site, or the robot's stack.")]
SITE = "tcp/127.0.0.1:7447"


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


@fleet.command("goal", cls=Command, hidden=True)  # the word of Nav2
@fleet.command(cls=Command)
def goto(
    name: Robot,
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


@fleet.command(cls=Command)
def dispatch(
    queue: Queue = Path("fleet.sqlite"),
    map_: Annotated[
        str,
        typer.Option("--map", envvar="ZENAV_MAP", help="The robots' saved map: ways are compared on it, not straight."),
    ] = "",
    min_battery: Annotated[float, typer.Option(min=0, max=100, help="V that a robot needs to get a task.")] = 0.0,
    lost_after: Annotated[
        float, typer.Option(min=5, max=3600, help="s that a robot may be silent or stopped until another one drives.")
    ] = 60.0,
    stack: Stacks = None,
) -> None:
    """Give the queue's tasks to robots until Ctrl-C: the oldest first, to the nearest robot that is free.

    Example: zenav fleet dispatch --map office --stack tcp/127.0.0.1:7447
    """
    from zenav.fleet.task_commands import dispatch

    raise typer.Exit(dispatch(queue, stack or [], map_, min_battery, lost_after))


@fleet.command(cls=Command)
def recordings(name: Robot, stack: Site = SITE) -> None:
    """List the recordings on a robot, over its link to the site.

    Example: zenav fleet recordings red
    """
    from zenav.fleet.site_recordings import list_robot_recordings

    raise typer.Exit(list_robot_recordings(name, stack))


@fleet.command(cls=Command)
def fetch(
    name: Robot,
    file: Annotated[str, typer.Argument(help="One of `zenav fleet recordings NAME`.", metavar="FILE.mcap")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where it goes.")] = Path(),
    stack: Site = SITE,
) -> None:
    """Fetch a recording of a robot. One that was interrupted goes on where it ended.

    Example: zenav fleet fetch red red-20261125-101500.mcap --out recordings
    """
    from zenav.fleet.site_recordings import fetch_recording

    raise typer.Exit(fetch_recording(name, file, out, stack))


@task.command("add", cls=Command)
def task_add(
    what: Annotated[str, typer.Argument(metavar="'PLACE|X,Y[,YAW] -> ...'", help="Where to drive, in order.")],
    only: Annotated[str, typer.Option("--only", metavar="NAME", help="The robot that must do it.")] = "",
    map_: MapName = "",
    queue: Queue = Path("fleet.sqlite"),
) -> None:
    """Put a task into the queue. It stays there until a robot has done it, whatever ends meanwhile.

    Example: zenav fleet task add '1,0 -> 4,-2,90'
    """
    from zenav.fleet.task_commands import add_task

    raise typer.Exit(add_task(queue, what, only, map_))


@task.command("list", cls=Command)
def task_list(
    every: Annotated[bool, typer.Option("--all", help="Also those that have ended.")] = False,
    as_json: Json = False,
    queue: Queue = Path("fleet.sqlite"),
) -> None:
    """List the tasks: state, robot, tries, and why the last try ended.

    Example: zenav fleet task list --all
    """
    from zenav.fleet.task_commands import list_tasks

    raise typer.Exit(list_tasks(queue, every, as_json))


@task.command("cancel", cls=Command)
def task_cancel(
    number: Annotated[int, typer.Argument(min=1, help="The task.")], queue: Queue = Path("fleet.sqlite")
) -> None:
    """Cancel a task. A robot that drives it stands as soon as zenav fleet dispatch says so.

    Example: zenav fleet task cancel 3
    """
    from zenav.fleet.task_commands import cancel_task

    raise typer.Exit(cancel_task(queue, number))
