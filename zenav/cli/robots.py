# SPDX-License-Identifier: Apache-2.0
"""`zenav robots` and `zenav robot new`. Only parsing; work is imported when it is due."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.parts import MAIN, Command, app, complete_robot, group

robot = group("Robot files of your own.")


@app.command(cls=Command, rich_help_panel=MAIN)
def robots() -> None:
    """List the robots that --robot NAME finds: the built-in ones, and the YAML files of the current folder.

    Example: zenav robots
    """
    from zenav.stack.new_robot import list_robots

    list_robots()


@robot.command(cls=Command)
def new(
    name: Annotated[str, typer.Argument(help="Name of the new robot: small letters, digits, underscores.")],
    from_: Annotated[
        str,
        typer.Option("--from", help="The robot to begin with: a name or a YAML file.", autocompletion=complete_robot),
    ] = "x80sv",
) -> None:
    """Write NAME.yaml into the current folder, a copy of another robot's file with its comments, to be edited.

    Example: zenav robot new my_robot --from jackal
    """
    from zenav.stack.new_robot import new_robot

    path = new_robot(name, from_, Path())
    sys.stdout.write(f"{path}: edit it, then: zenav config check --robot {name}\n")
