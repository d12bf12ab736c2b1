# SPDX-License-Identifier: Apache-2.0
"""`zenav site`. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import Command, RobotName, Setting, group
from zenav.cli.securing import Folder

site = group("A site: the router that robots link to, and the page of them all.")

Local = Annotated[
    str,
    typer.Option(metavar="ROUTER", help="Loopback address for programs of this computer: --stack of their commands."),
]


@site.command(cls=Command)
def up(
    listen: Annotated[
        str, typer.Option(metavar="ROUTER", help="Where robots and people connect.")
    ] = "tls/0.0.0.0:7449",
    local: Local = "tcp/127.0.0.1:7447",
    folder: Folder = "",
) -> None:
    """Run the router of a site until Ctrl-C. Robots link to it by zenav up --site.

    Make its certificates first: zenav secure init --name SITE, then zenav secure add ROBOT --role robot.

    Example: zenav site up --listen tls/0.0.0.0:7449
    """
    from zenav.fleet.site_router import run_site

    raise typer.Exit(run_site(listen, local, folder))


@site.command(cls=Command)
def page(
    robot: RobotName = "x80sv",
    local: Local = "tcp/127.0.0.1:7447",
    page_host: Annotated[
        str, typer.Option(help="Address of the page for other computers, as 0.0.0.0; needs certificates.")
    ] = "",
    set_: Setting = None,
    log: Annotated[str, typer.Option(help="DEBUG, INFO, WARNING or ERROR.")] = "INFO",
) -> None:
    """Serve the page of all robots of the site until Ctrl-C. --name is the robot that it shows first.

    Example: zenav site page --name red
    """
    from zenav.fleet.site_page import run_site_page

    run_site_page(robot, local, page_host, set_ or [], log)
