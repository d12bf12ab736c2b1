# SPDX-License-Identifier: Apache-2.0
"""`zenav doctor`, `foxglove`, `topic`, `request`, `schema`, `config`. Only parsing; work is imported when it is due."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.parts import DRIVE, LOOK, Command, Json, Key, RobotName, Seconds, Setting, Stack, app, group

Message = Annotated[str, typer.Argument(help="Its fields as JSON; `zenav schema` lists them.", metavar="JSON")]


def _requests() -> list[str]:
    from shared.requests import REQUESTS

    return [key.partition("/")[2] for row in REQUESTS for key in row.keys]


def _names() -> list[str]:
    from shared.requests import REQUESTS
    from shared.topics import TOPICS

    return [*(row.key for row in TOPICS), *(row.key for row in REQUESTS)]


topic = group("Look at what goes over the wire, and publish.")
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


@topic.command(cls=Command)
def pub(
    key: Key,
    text: Message,
    hz: Annotated[float, typer.Option(min=0, max=1000, help="Messages a second until Ctrl-C; 0: one.")] = 0.0,
    publisher: Annotated[str, typer.Option("--as", help="Publish in the place of this service.")] = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Publish a message, given as JSON. Its stamp is the time of sending, unless it is given.

    Example: zenav topic pub cmd/teleop '{"v": 0.1, "w": 0, "reason": ""}' --hz 20
    """
    from zenav.client.sending import publish_json

    publish_json(robot, stack, key, text, hz, publisher)


@topic.command(cls=Command)
def check(key: Key, seconds: Seconds = 3.0, robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """Give the reasons why the messages on a topic do not pass: publisher, session, sequence, age, sizes.

    Example: zenav topic check scan
    """
    from zenav.client.topic_check import check_topic

    raise typer.Exit(check_topic(robot, stack, key, seconds))


@app.command(cls=Command, rich_help_panel=DRIVE)
def request(
    name: Annotated[str, typer.Argument(help="Request, like navigate or set/planner.", autocompletion=_requests)],
    text: Message = "{}",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
) -> None:
    """Send a request, given as JSON, and print the reply as JSON. Status 1 where it is refused.

    Example: zenav request navigate '{"poses": [[1, 0, 0]], "dwell": 0, "loops": 1, "any_heading": true}'
    """
    from zenav.client.sending import request_json

    raise typer.Exit(request_json(robot, stack, name, text))


@app.command(cls=Command, rich_help_panel=LOOK)
def schema(
    name: Annotated[
        str, typer.Argument(help="Only this message, topic or request, like LaserScan or scan.", autocompletion=_names)
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="JSON Schema (2020-12).")] = False,
) -> None:
    """Print the fields of messages and requests, with types, units and bounds.

    Example: zenav schema --json
    """
    from zenav.wire.json_schema import show_schema

    show_schema(name, as_json)


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
def doctor(robot: RobotName = "x80sv", stack: Stack = "0") -> None:
    """What is wrong on this machine, and how to fix it.

    Example: zenav doctor
    """
    from zenav.stack.doctor import doctor

    raise typer.Exit(doctor(robot, stack))


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
