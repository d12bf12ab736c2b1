# SPDX-License-Identifier: Apache-2.0
"""`zenav slam`, `convert` and `replay`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from zenav.cli.parts import (
    FILES,
    BaseFrame,
    Command,
    OdomFrame,
    Registrar,
    Setting,
    Stack,
    TopicOdom,
    TopicScan,
    With,
    app,
)


def _formats() -> list[str]:
    from zenav.convert.export import FORMATS

    return list(FORMATS)


@app.command(cls=Command, rich_help_panel=FILES)
def slam(
    log: Annotated[Path, typer.Argument(help="CARMEN log, ROS 1 or 2 bag (file or folder), or recording.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for trajectory, map and report.")],
    mode: Annotated[
        Literal["map", "localise", "continue"],
        typer.Option(help="A new map; the robot found on a saved one, which stays; a saved one that goes on."),
    ] = "map",
    saved_map: Annotated[
        Path | None, typer.Option("--map", help="Folder of the saved map, or a YAML of ROS map_server.", metavar="DIR")
    ] = None,
    topic_scan: TopicScan = "",
    topic_odom: TopicOdom = "",
    base_frame: BaseFrame = "",
    odom_frame: OdomFrame = "",
    registrar: Registrar = "line",
) -> None:
    """Make a map of a logged drive, or find the robot on a saved one.

    Example: zenav slam intel.log --out out/intel
    """
    from zenav.convert.content import Choice
    from zenav.slam.command import slam_command

    slam_command(log, out, mode, saved_map, Choice(topic_scan, topic_odom, "", base_frame, odom_frame), registrar)


@app.command(cls=Command, rich_help_panel=FILES)
def convert(
    source: Annotated[
        Path, typer.Argument(help="CARMEN log, ROS 1 or 2 bag (file or folder), or recording.", metavar="IN")
    ],
    out: Annotated[
        Path, typer.Argument(help="Its name gives the format: .mcap .bag .tum .log, or a folder: ROS 2.", metavar="OUT")
    ],
    to: Annotated[
        str,
        typer.Option(
            help="Format, where the name has none: ros2, ros2-sqlite, ros1, zenav, tum, carmen, foxglove, map.",
            autocompletion=_formats,
        ),
    ] = "",
    trajectory: Annotated[
        Literal["pose", "odom", "truth"] | None,
        typer.Option(help="For TUM: whose poses; without it the first there is."),
    ] = None,
    topic_scan: TopicScan = "",
    topic_odom: TopicOdom = "",
    topic_pose: Annotated[
        str, typer.Option(help="Of a bag: the pose's topic; without it: the best by type, or tf.")
    ] = "",
    base_frame: BaseFrame = "",
    odom_frame: OdomFrame = "",
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file that is there.")] = False,
) -> None:
    """Write a log, a bag or a recording in another format: ROS 1 or 2 bag, TUM, CARMEN, Foxglove.

    Example: zenav convert run.mcap run_ros2 --to ros2
    """
    from zenav.convert.command import convert_command
    from zenav.convert.content import Choice

    chosen = Choice(topic_scan, topic_odom, topic_pose, base_frame, odom_frame)
    convert_command(source, out, to, chosen, trajectory or "", force)


@app.command(cls=Command, rich_help_panel=FILES)
def replay(
    recording: Annotated[Path, typer.Argument(help="Recording.", metavar="FILE.mcap")],
    topics: Annotated[
        str, typer.Option("--topics", help="Play only these; a family (health) is all of its keys.", metavar="A,B")
    ] = "",
    remap: Annotated[
        list[str] | None, typer.Option("--remap", help="Play a topic under another key.", metavar="OLD=NEW")
    ] = None,
    rate: Annotated[float, typer.Option(min=0.01, max=100, help="Recorded seconds in a real one.")] = 1.0,
    start: Annotated[float, typer.Option(min=0, help="s from the recording's beginning.")] = 0.0,
    end: Annotated[float, typer.Option(min=0, help="s from the recording's beginning; 0: its end.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Again and again.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Begin paused; space goes on, n steps.")] = False,
    now: Annotated[
        bool, typer.Option("--now", help="Stamps as if it happened now, so that live services take it.")
    ] = False,
    commands: Annotated[bool, typer.Option("--commands", help="Play what robots obey (cmd, goal, estop) too.")] = False,
    robot: Annotated[
        str,
        typer.Option(
            "--robot", help="Name to play under; with --through: whose configuration to take. Else the recorded."
        ),
    ] = "",
    stack: Stack = "0",
    through: Annotated[
        str, typer.Option(help="Not onto Zenoh: through these services, here, at full speed.", metavar="A,B")
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="With --through: recording of what they publish now.", metavar="OUT.mcap")
    ] = None,
    with_: With = "",
    set_: Setting = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Field by field: the first difference and the largest.")
    ] = False,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(help="How far a number may be off to count as equal.", metavar="TOPIC[.FIELD]=VALUE"),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(help="Compare with this recording, as a table of figures.", metavar="OTHER.mcap"),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="With --against: both ways and maps, as a picture.", metavar="PNG")
    ] = None,
    pdb: Annotated[bool, typer.Option("--pdb", help="Where a service raises, open the debugger.")] = False,
) -> None:
    """Play a recording onto Zenoh, or feed it to services and compare what they say.

    Example: zenav replay run.mcap --through odometry,mapper --out again.mcap
    """
    from zenav.replay.player_clock import PlaybackOptions
    from zenav.replay.report import ReplayOptions, replay

    wish = PlaybackOptions(
        keys=topics,
        remap=tuple(remap or ()),
        rate=rate,
        start=start,
        end=end,
        loop=loop,
        paused=paused,
        now=now,
        commands=commands,
    )
    rerun = ReplayOptions(
        through=through,
        out=out,
        settings=tuple(set_ or ()),
        compare=compare,
        tolerances=tuple(tolerance or ()),
        against=against,
        picture=picture,
        pdb=pdb,
    )
    raise typer.Exit(replay(recording, robot, stack, wish, rerun))
