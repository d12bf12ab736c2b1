# SPDX-License-Identifier: Apache-2.0
"""`zenav config set`, `get`, `reset`, `list`, `save`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.looking import config
from zenav.cli.parts import Command, Json, RobotName, Stack


def _names() -> list[str]:
    from shared.settings import BY_NAME

    return list(BY_NAME)


SettingName = Annotated[
    str, typer.Argument(help="Dotted, like planner.cost.clearance_weight.", metavar="NAME", autocompletion=_names)
]


@config.command("set", cls=Command)
def config_set(
    changes: Annotated[
        list[str], typer.Argument(help="NAME=VALUE, or NAME VALUE.", metavar="NAME=VALUE...", autocompletion=_names)
    ],
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Change settings of the running robot, all or none, until it is started again. See `zenav config list`.

    Example: zenav config set planner.cost.clearance_weight=4.0 robot.drive.max_speed=0.4
    """
    from zenav.stack.runtime_config import set_settings

    set_settings(robot, stack, changes)


@config.command("get", cls=Command)
def config_get(name: SettingName, robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Print the value that holds in the running robot.

    Example: zenav config get planner.cost.clearance_weight
    """
    from zenav.stack.runtime_config import get_setting

    get_setting(robot, stack, name)


@config.command("reset", cls=Command)
def config_reset(
    names: Annotated[list[str] | None, typer.Argument(help="Without one: all.", autocompletion=_names)] = None,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Go back to the values with which the robot was started.

    Example: zenav config reset planner.cost.clearance_weight
    """
    from zenav.stack.runtime_config import reset_settings

    reset_settings(robot, stack, names or [])


@config.command("list", cls=Command)
def config_list(as_json: Json = False, robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """List the settings that may change while the robot runs: value, bounds, and which were set.

    Example: zenav config list --json
    """
    from zenav.stack.runtime_config import list_settings

    list_settings(robot, stack, as_json)


@config.command("save", cls=Command)
def config_save(
    path: Annotated[Path, typer.Argument(help="The new file.", metavar="FILE.yaml")],
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Write the robot's file with the values that hold now into a new file, to be used with --robot.

    Example: zenav config save tuned.yaml
    """
    from zenav.stack.runtime_config import save_settings

    save_settings(robot, stack, path)
