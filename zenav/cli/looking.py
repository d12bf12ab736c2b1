# SPDX-License-Identifier: Apache-2.0
"""`zenav doctor`, `foxglove`, `topic` and `config`. Only parsing; work is imported when it is due."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.parts import LOOK, Command, Json, Key, RobotName, Seconds, Setting, Stack, app, group

topic = group("Look at what goes over the wire.")
config = group("Look at the configuration.")


@topic.command("list", cls=Command)
def topic_list(as_json: Json = False) -> None:
    """Every topic: key, type, rate (Hz), publisher, description.

    Example: zenav topic list --json
    """
    from zenav.cli.topic_list import list_topics

    list_topics(as_json)


@topic.command(cls=Command)
def echo(
    key: Key,
    once: Annotated[bool, typer.Option("--once", help="One message.")] = False,
    number: Annotated[int, typer.Option("--number", "-n", min=0, help="Messages; 0 is until Ctrl-C.")] = 0,
    as_json: Json = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Show the messages on a topic.

    Example: zenav topic echo pose --once
    """
    from zenav.client.topic import echo

    raise typer.Exit(echo(robot, stack, key, 1 if once else number, as_json))


@topic.command(cls=Command)
def hz(key: Key, seconds: Seconds = 5.0, as_json: Json = False, robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Measure a topic: rate (Hz), jitter and age (ms), size.

    Example: zenav topic hz scan --seconds 10
    """
    from zenav.client.topic import measure_rate

    raise typer.Exit(measure_rate(robot, stack, key, seconds, as_json))


@config.command("show", cls=Command)
def config_show(
    section: Annotated[str, typer.Argument(help="Only this section.")] = "",
    origin: Annotated[bool, typer.Option("--origin", help="With the place that each value comes from.")] = False,
    robot: RobotName = "x80sv",
    set_: Setting = None,
) -> None:
    """Print the values that a start uses, as YAML. Those of a running robot: zenav config list.

    Example: zenav config show guard --origin
    """
    from zenav.stack.config_report import show_config

    show_config(robot, set_ or [], section, origin)


@config.command("check", cls=Command)
def config_check(robot: RobotName = "x80sv", set_: Setting = None) -> None:
    """Check a robot's file: every section and every value.

    Example: zenav config check --robot jackal
    """
    from zenav.stack.config_report import check_config

    check_config(robot, set_ or [])


@app.command(cls=Command, rich_help_panel=LOOK)
def doctor(stack: Stack = "0") -> None:
    """What is wrong on this machine, and how to fix it.

    Example: zenav doctor
    """
    from zenav.stack.doctor import doctor

    raise typer.Exit(doctor(stack))


@app.command(cls=Command, rich_help_panel=LOOK)
def foxglove(
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 8765,
    host: Annotated[
        str, typer.Option(help="Address to listen on; others than 127.0.0.1 need certificates.")
    ] = "127.0.0.1",
    certificate: Annotated[
        Path | None, typer.Option("--cert", metavar="FILE", help="PEM; without it the robot's own certificate.")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", metavar="FILE", help="PEM, the private key of --cert.")] = None,
    layout: Annotated[bool, typer.Option("--layout", help="Write the layout for the app to stdout, and end.")] = False,
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Show the running stack in Foxglove or Lichtblick, and take goals and driving from there, until Ctrl-C.

    With --cert, or on an address of a network, it serves TLS, and each client gives a token (zenav secure token).

    Example: zenav foxglove --layout > layout.json; zenav foxglove
    """
    if layout:
        from zenav.foxglove.layout import layout as text

        sys.stdout.write(text())
        return
    from zenav.foxglove.server import serve

    serve(robot, stack, host, port, certificate, key)
