# SPDX-License-Identifier: Apache-2.0
"""`zenav page`. Only parsing; work is imported when it is due."""

from typing import Annotated, Literal

import typer

from zenav.cli.parts import Command, RobotName, Setting, Stack, group

page = group("Logins of the robot's page: invite users of other computers, list and end their sessions.")


@page.command(cls=Command)
def invite(
    role: Annotated[Literal["viewer", "operator", "admin"], typer.Option(help="What the user may do: docs/page.md.")],
    name: Annotated[str, typer.Option(help="Name of the user for others and the audit; without it: the role.")] = "",
    minutes: Annotated[float, typer.Option(min=1, max=1440, help="For which the link opens the page.")] = 15.0,
    host: Annotated[str, typer.Option(help="Name or address of the robot in the link.")] = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    set_: Setting = None,
) -> None:
    """Write a link that logs in once, with its QR code for a phone.

    Example: zenav page invite --role operator --name anna
    """
    from zenav.page.invitations import invite

    invite(role, name, minutes, host, robot, stack, set_ or [])


@page.command(cls=Command)
def sessions() -> None:
    """List the sessions of the page, and the invitations that are still open.

    Example: zenav page sessions
    """
    from zenav.page.invitations import list_sessions

    list_sessions()


@page.command(cls=Command)
def revoke(
    name: Annotated[str, typer.Argument(help="Of sessions and invitations, or all.", metavar="NAME|all")],
) -> None:
    """End the sessions and invitations of a user. Open pages close within seconds.

    Example: zenav page revoke anna
    """
    from zenav.page.invitations import revoke

    revoke(name)
