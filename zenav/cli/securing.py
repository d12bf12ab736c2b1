# SPDX-License-Identifier: Apache-2.0
"""`zenav secure`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from zenav.cli.parts import Command, Json, RobotName, Stack, group

secure = group("Members of a robot: access from other computers, by certificates.")

Folder = Annotated[
    str,
    typer.Option(
        "--dir", envvar="ZENAV_SECURE", metavar="DIR", help="Folder of credentials; without it: in ~/.config/zenav."
    ),
]
Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", help="A further name or address of this computer; may be repeated."),
]
Name = Annotated[str, typer.Argument(help="A small letter first; then small letters, digits, - and _.")]
File = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Without it: NAME.pem.")]
Days = Annotated[int, typer.Option(min=0, max=3650, help="How long the certificate holds.")]


@secure.command(cls=Command)
def init(hosts: Hosts = None, robot: RobotName = "x80sv", folder: Folder = "") -> None:
    """Make the robot's certificate authority and its own certificate.

    Example: zenav secure init --host robot.example.org
    """
    from zenav.secure.members import init_folder

    init_folder(robot, folder, hosts or [])


@secure.command(cls=Command)
def add(
    name: Name,
    role: Annotated[
        Literal["viewer", "operator", "admin", "service", "robot"],
        typer.Option(help="A viewer sees; an operator also drives; an admin may do everything; robot: of a site."),
    ] = "viewer",
    days: Days = 365,
    out: File = None,
    folder: Folder = "",
) -> None:
    """Give a person, or a service on another computer, access. Writes a file with its private key.

    Example: zenav secure add anna --role operator
    """
    from shared.secure_folder import MemberRole
    from zenav.secure.members import add_member

    add_member(name, MemberRole(role), folder, out, days)


@secure.command(cls=Command)
def revoke(name: Name, folder: Folder = "") -> None:
    """End a member's access now.

    Example: zenav secure revoke anna
    """
    from zenav.secure.members import revoke_member

    revoke_member(name, folder)


@secure.command(cls=Command)
def renew(
    name: Annotated[str, typer.Argument(help="A member; without it the robot's own certificate.")] = "",
    days: Days = 365,
    hosts: Hosts = None,
    out: File = None,
    folder: Folder = "",
) -> None:
    """Renew a certificate before it ends: a member's, whose old one ends, or the robot's.

    Example: zenav secure renew anna
    """
    from zenav.secure.members import renew_certificates

    renew_certificates(name, folder, out, days, hosts or [])


@secure.command(cls=Command)
def token(name: Name, folder: Folder = "") -> None:
    """Print a token of a member for the Foxglove app, once; an older one ends.

    Example: zenav secure token anna
    """
    from zenav.secure.tokens import issue_token

    issue_token(name, folder)


@secure.command("list", cls=Command)
def list_(json: Json = False, folder: Folder = "") -> None:
    """List the members, and until when their certificates hold.

    Example: zenav secure list
    """
    from zenav.secure.members import list_members

    list_members(folder, json)


@secure.command(cls=Command)
def accept(
    file: Annotated[Path, typer.Argument(help="What `zenav secure add` wrote on the robot.")],
    host: Annotated[str, typer.Option(help="The robot's computer: a name or an address.")],
) -> None:
    """Keep the credentials for a robot, on the computer of a member.

    Example: zenav secure accept anna.pem --host robot.local
    """
    from zenav.secure.members import accept_credentials

    accept_credentials(file, host)


@secure.command(cls=Command)
def check(
    at: Annotated[str, typer.Argument(metavar="HOST:PORT", help="Where the gateway listens.")] = "127.0.0.1:7448",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    json: Json = False,
    folder: Folder = "",
) -> None:
    """Connect as each role, with wrong certificates and with none, and print what is refused.

    Members are cut off for some seconds.

    Example: zenav secure check robot.local:7448
    """
    from zenav.secure.check import check_access

    raise typer.Exit(check_access(at, robot, stack, folder, json))
