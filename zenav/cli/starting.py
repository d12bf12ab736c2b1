# SPDX-License-Identifier: Apache-2.0
"""`zenav demo`, `up` and `run`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from zenav.cli.parts import (
    MAIN,
    At,
    Command,
    Out,
    RobotName,
    SavedMapMode,
    Setting,
    Simulated,
    Stack,
    With,
    World,
    app,
)

Page = Annotated[bool, typer.Option("--dashboard/--no-dashboard", help="Serve the robot's page to browsers.")]
Browser = Annotated[
    bool, typer.Option("--browser/--no-browser", help="Open the page in a browser, in a desktop session.")
]


def _services() -> list[str]:
    from shared.topics import SERVICES

    return list(SERVICES)


@app.command(cls=Command, rich_help_panel=MAIN)
def demo(
    headless: Annotated[bool, typer.Option("--headless", help="Plain lines instead of a live table.")] = False,
    seconds: Annotated[float, typer.Option(min=5, help="s: give up after this long.")] = 1800.0,
    seed: Annotated[int, typer.Option(min=0, help="Of noise, slip, people and loose things.")] = 0,
    record: Annotated[
        Path | None, typer.Option(help="Recording; without it: in the run's folder.", metavar="FILE.mcap")
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="In one process on the virtual clock, repeatable.")
    ] = False,
    robots: Annotated[
        int, typer.Option(min=1, max=20, help="Robots in one world, which drive to random goals; live 4 at most.")
    ] = 1,
    hardware: Annotated[
        Simulated, typer.Option(help="What the simulator stands behind: its messages, or ports that speak bytes.")
    ] = "messages",
    out: Out = None,
    page: Page = True,
    browser: Browser = True,
    with_: With = "",
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Explore an unknown office, then drive to five goals and back.

    Example: zenav demo --headless --seed 3
    """
    if robots > 1:
        from zenav.scenario.fleet_demo import fleet_demo

        given = set_ or []
        raise typer.Exit(fleet_demo(robot, world, robots, seed, seconds, lockstep, given, out, page, browser))
    from zenav.scenario.demo import demo
    from zenav.stack.hardware import Hardware

    chosen = Hardware(hardware)
    raise typer.Exit(
        demo(robot, world, seed, seconds, headless, record, lockstep, set_ or [], chosen, out, page, browser)
    )


@app.command(cls=Command, rich_help_panel=MAIN)
def up(
    robot: RobotName = "x80sv",
    world: World = "",
    hardware: Annotated[
        Simulated | None,
        typer.Option(help="What the simulator stands behind: its messages (default), or ports that speak bytes."),
    ] = None,
    only: Annotated[str, typer.Option(help="Only these services: a,b", metavar="A,B")] = "",
    saved_map: Annotated[
        str, typer.Option("--map", help="Begin on this saved map: a name below maps/, or a folder.", metavar="DIR")
    ] = "",
    mode: SavedMapMode = "localise",
    at: At = None,
    speed: Annotated[float, typer.Option(min=0.01, max=100, help="Simulated seconds in a real one.")] = 1.0,
    page: Page = True,
    page_host: Annotated[
        str, typer.Option(help="Address of the page for other computers, as 0.0.0.0; needs `zenav secure init`.")
    ] = "",
    browser: Browser = True,
    remote: Annotated[
        bool, typer.Option("--remote", help="Let members in from other computers: see zenav secure.")
    ] = False,
    external: Annotated[
        str,
        typer.Option(
            help="Programs of yours take the place of these services. Says what is wrong with their messages.",
            metavar="A,B",
        ),
    ] = "",
    with_: With = "",
    ros2: Annotated[
        str,
        typer.Option(
            "--ros2", help="Bridge to ROS 2 nodes by their router: tcp/HOST:7447, or tls/HOST:7447.", metavar="ROUTER"
        ),
    ] = "",
    site: Annotated[
        str, typer.Option(help="Link to a site's router: tls/HOST:7449. See zenav site.", metavar="ROUTER")
    ] = "",
    stack: Stack = "0",
    set_: Setting = None,
) -> None:
    """Start the services as processes, and bring dead ones back, until Ctrl-C.

    Example: zenav up --world office
    """
    from shared.messages import MapMode
    from zenav.client.map_modes import OnMap
    from zenav.stack.hardware import Hardware
    from zenav.stack.page import host_settings
    from zenav.stack.up import UpOptions, up

    up(
        UpOptions(
            robot=robot,
            world=world,
            hardware=Hardware(hardware) if hardware else None,
            only=[name for name in only.split(",") if name],
            speed=speed,
            stack=stack,
            settings=[*(set_ or []), *host_settings(page_host)],
            on_map=OnMap.of(saved_map, MapMode(mode), at) if saved_map else None,
            page=page,
            browser=browser,
            remote=remote,
            external=[name for name in external.split(",") if name],
            ros2=ros2,
            site=site,
        )
    )


@app.command(cls=Command, rich_help_panel=MAIN)
def warm(
    robot: RobotName = "x80sv",
    set_: Setting = None,
    every: Annotated[bool, typer.Option("--all", help="For every controller, on the X80SV and the Jackal.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Remove what is compiled first.")] = False,
    times: Annotated[bool, typer.Option("--times", help="List what each kernel took, in s of CPU.")] = False,
) -> None:
    """Compile the kernels of a robot ahead, so that `zenav up` starts at once.

    Example: zenav warm --robot jackal
    """
    from zenav.stack.warm import report

    report(robot, set_ or [], every, again, times)


@app.command(cls=Command, rich_help_panel=MAIN)
def run(
    service: Annotated[str, typer.Argument(help="Name of the service.", autocompletion=_services)],
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    with_: With = "",
    set_: Setting = None,
    clock: Annotated[str, typer.Option(metavar="EPOCH:SPEED", help="Simulated time: ns, times as fast as real.")] = "",
    memory: Annotated[
        str, typer.Option(metavar="FOLDER", help="Keep what a restart must not lose: the map, settings that were set.")
    ] = "",
    log: Annotated[str, typer.Option(help="DEBUG, INFO, WARNING or ERROR.")] = "INFO",
) -> None:
    """Run one service alone in the foreground, against whatever else runs; also under a debugger.

    Example: zenav run mapper --log DEBUG
    """
    from zenav.stack.up import run_service

    run_service(service, robot, stack, settings=set_ or [], clock=clock, memory=memory, log=log)


@app.command(cls=Command, rich_help_panel=MAIN)
def ros2(
    router: Annotated[
        str, typer.Option(help="Router of the ROS 2 nodes: tcp/HOST:7447 or tls/HOST:7447.", metavar="ROUTER")
    ] = "tcp/127.0.0.1:7447",
    bridge: Annotated[
        Literal["rmw_zenoh", "dds"], typer.Option(help="What they use: dds is with zenoh-bridge-ros2dds beside them.")
    ] = "rmw_zenoh",
    domain: Annotated[int, typer.Option(min=0, max=232, help="ROS_DOMAIN_ID of the nodes.")] = 0,
    distro: Annotated[Literal["humble", "jazzy", "kilted"], typer.Option(help="Their distribution.")] = "jazzy",
    namespace: Annotated[str, typer.Option(help="Before the names of topics and services, as /robot1.")] = "",
    robot: RobotName = "x80sv",
    stack: Stack = "0",
    set_: Setting = None,
    log: Annotated[str, typer.Option(help="DEBUG, INFO, WARNING or ERROR.")] = "INFO",
) -> None:
    """Bridge a running stack to ROS 2 nodes over Zenoh, without ROS here. Until Ctrl-C.

    Example: zenav ros2 --router tcp/192.168.1.7:7447 --domain 0
    """
    from zenav.stack.ros2 import run_bridge

    run_bridge(robot, stack, router, bridge, domain, distro, namespace, set_ or [], log)
