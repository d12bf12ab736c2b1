# SPDX-License-Identifier: Apache-2.0
"""`zenav install-service` and `uninstall-service`. Only parsing; work is imported when it is due."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.parts import MAIN, Command, RobotName, Setting, World, app

System = Annotated[bool, typer.Option("--system/--user", help="For the whole machine (with sudo), or for this user.")]


@app.command(cls=Command, rich_help_panel=MAIN)
def install_service(
    robot: RobotName,
    system: System = False,
    print_: Annotated[bool, typer.Option("--print", help="Only show what would be written.")] = False,
    udev: Annotated[bool, typer.Option("--udev", help="Also the udev rules of the robot's serial adapters.")] = False,
    folder: Annotated[Path, typer.Option(help="Where it runs: maps, recordings and logs go there.")] = Path(),
    world: World = "",
    set_: Setting = None,
) -> None:
    """Install a systemd unit that runs `zenav up`, restarts it, and starts it with the machine.

    Example: zenav install-service --robot my_robot --user
    """
    from zenav.stack.systemd_service import SystemdService, install, udev_rules, unit_text

    service = SystemdService(robot, "system" if system else "user", folder, world, tuple(set_ or []))
    if not print_:
        install(service, udev)
        return
    file = service.file
    sys.stdout.write(f"# {service.unit}\n{unit_text(service)}")
    if udev:
        sys.stdout.write(f"\n# udev rules\n{udev_rules(file)}")


@app.command(cls=Command, rich_help_panel=MAIN)
def uninstall_service(robot: RobotName, system: System = False) -> None:
    """Stop the unit of a robot and remove it.

    Example: zenav uninstall-service --robot my_robot
    """
    from zenav.stack.systemd_service import SystemdService, uninstall

    service = SystemdService(robot, "system" if system else "user", Path())
    uninstall(service.name, service.scope)
