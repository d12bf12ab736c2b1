# SPDX-License-Identifier: Apache-2.0
"""`zenav bench`: joined maps and shared exploration. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.measuring_files import bench as bench  # with more commands below
from zenav.cli.parts import Command, Out, RobotName, Seeds, Setting, World


@bench.command("merge", cls=Command)
def bench_merge(
    buildings: Annotated[str, typer.Option(help="Made-up buildings, by number.", metavar="0-19")] = "0-9",
    overlaps: Annotated[str, typer.Option(help="Percent of the rooms that both maps have.", metavar="30,50")] = "30",
    strangers: Annotated[
        int, typer.Option(min=0, help="Other buildings that each is tried against, beside another floor of it.")
    ] = 2,
    jobs: Annotated[int, typer.Option(min=1, help="Pairs at a time.")] = 1,
    maps: Annotated[
        Path | None, typer.Option(help="Folder of an earlier run, with the maps; none: each part is driven first.")
    ] = None,
    out: Out = None,
    robot: RobotName = "x80sv",
    set_: Setting = None,
) -> None:
    """Join maps of two parts of a building, against the truth; maps of two buildings or floors must be refused.

    Example: zenav bench merge --buildings 0-9 --overlaps 30,50 --jobs 2 --out merge.json
    """
    from zenav.bench.merge import merge

    raise typer.Exit(merge(robot, buildings, overlaps, strangers, jobs, maps, out, set_ or []))


@bench.command("explore", cls=Command)
def bench_explore(
    robots: Annotated[str, typer.Option(help="Numbers of robots; each is run.", metavar="1,2")] = "1,2",
    seeds: Seeds = "0-2",
    seconds: Annotated[float, typer.Option(min=5, help="s of virtual time: give up after this long.")] = 1200.0,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time.")] = 1,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Explore a world with one robot and with several that share its frontiers: time, contacts, the joined map.

    Example: zenav bench explore --robots 1,2 --world office --seeds 0-2 --out explore.json
    """
    from zenav.bench.explore import explore

    raise typer.Exit(explore(robot, world, robots, seeds, seconds, jobs, out, set_ or []))
