# SPDX-License-Identifier: Apache-2.0
"""`zenav bench`: the stack and its parts. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from zenav.cli.measuring_maps import bench as bench  # with more commands below
from zenav.cli.parts import Command, Out, Registrar, RobotName, Seeds, Setting, World


@bench.command("office", cls=Command)
def bench_office(
    seeds: Seeds = "0-9",
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time (not with --live).")] = 1,
    out: Out = None,
    live: Annotated[bool, typer.Option("--live", help="As processes over Zenoh, in real time.")] = False,
    seconds: Annotated[float, typer.Option(min=5, help="s of the stack's time: give up after this long.")] = 2400.0,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Explore and drive to goals in an office, once a seed.

    Example: zenav bench office --seeds 0-9 --jobs 2 --out office.json
    """
    from zenav.bench.office import office

    raise typer.Exit(office(robot, world, seeds, jobs, out, live, seconds, set_ or []))


@bench.command("buildings", cls=Command)
def bench_buildings(
    buildings: Annotated[str, typer.Option(help="Made-up buildings, by number.", metavar="0-19")] = "0-19",
    jobs: Annotated[int, typer.Option(min=1, help="Buildings at a time.")] = 1,
    out: Out = None,
    robot: RobotName = "x80sv",
    set_: Setting = None,
) -> None:
    """Tour made-up buildings: pose and map against the truth.

    Example: zenav bench buildings --jobs 2 --out buildings.json
    """
    from zenav.bench.buildings import buildings as run

    raise typer.Exit(run(robot, buildings, jobs, out, set_ or []))


@bench.command("barn", cls=Command)
def bench_barn(
    worlds: Annotated[
        Path | None, typer.Argument(metavar="WORLDS", help="barn_worlds.json.gz, or the folder that holds it.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, help="Runs of each world, seeds 0, 1, ...")] = 10,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time.")] = 1,
    chosen: Annotated[str, typer.Option("--worlds", help="Only these of the file.", metavar="1-20")] = "",
    out: Out = None,
    trajectories: Annotated[
        Path | None, typer.Option(help="Folder for the true motion of each run, a CSV each.", metavar="DIR")
    ] = None,
    noise: Annotated[bool, typer.Option("--noise", help="Worse laser, odometry and latency than the challenge's.")] = (
        False
    ),
    crowd: Annotated[bool, typer.Option("--crowd", help="Through moving crowds, made by number, instead.")] = False,
    cluster: Annotated[
        str, typer.Option(help="A Dask scheduler whose workers see the same folders.", metavar="tcp://HOST:PORT")
    ] = "",
    robot: RobotName = "jackal",
    set_: Setting = None,
) -> None:
    """Drive through the cluttered worlds of the BARN challenge, without a map, by its rule and score.

    Example: zenav bench barn barn_worlds.json.gz --out barn.json
    """
    from zenav.bench.barn import barn

    raise typer.Exit(barn(worlds, robot, runs, jobs, chosen, out, trajectories, noise, crowd, set_ or [], cluster))


@bench.command("localise", cls=Command)
def bench_localise(
    buildings: Annotated[str, typer.Option(help="Made-up buildings, by number.", metavar="0-19")] = "0-19",
    poses: Annotated[int, typer.Option(min=1, help="Random poses, shared among the buildings.")] = 100,
    jobs: Annotated[int, typer.Option(min=1, help="Buildings at a time.")] = 1,
    maps: Annotated[
        Path | None, typer.Option(help="Folder of an earlier run, with the maps; none: each building is toured first.")
    ] = None,
    out: Out = None,
    robot: RobotName = "x80sv",
    set_: Setting = None,
    map_format: Annotated[
        Literal["zenav", "ros"], typer.Option(help="The stack's own maps, or pgm and yaml made of them.")
    ] = "zenav",
    cell: Annotated[float, typer.Option(min=0.05, max=0.5, help="m a cell of the pgm, a multiple of 0.05.")] = 0.05,
) -> None:
    """Find the robot from nowhere on saved maps of made-up buildings; carry it away and find it again.

    Example: zenav bench localise --poses 100 --jobs 2 --out localise.json
    """
    from zenav.bench.localise import localise as run

    raise typer.Exit(run(robot, buildings, poses, jobs, maps, out, set_ or [], cell if map_format == "ros" else 0.0))


@bench.command("sim", cls=Command)
def bench_sim(out: Out = None) -> None:
    """How many times faster than real time the simulator runs on one core.

    Example: zenav bench sim --out sim.json
    """
    from zenav.bench.sim import sim

    raise typer.Exit(sim(out))


@bench.command("stack", cls=Command)
def bench_stack(
    seconds: Annotated[float, typer.Option(min=5, help="s of driving to measure.")] = 40.0,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    remote: Annotated[
        bool, typer.Option("--remote", help="With the gateway, and a member that takes cmd/vel over TLS.")
    ] = False,
    set_: Setting = None,
) -> None:
    """Latency from scan to cmd/vel across processes, CPU and memory of each, time to first motion.

    Example: zenav bench stack --out stack.json
    """
    from zenav.bench.stack import stack

    raise typer.Exit(stack(robot, world, seconds, out, set_ or [], remote))


@bench.command("page", cls=Command)
def bench_page(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of all attacks.")] = 3,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """What hostile clients of the page cost the robot: the time from scan to cmd/vel during attacks and without.

    Example: zenav bench page --out page.json
    """
    from zenav.bench.page import page

    raise typer.Exit(page(robot, world, rounds, out, set_ or []))


@bench.command("browser", cls=Command)
def bench_browser(
    seconds: Annotated[float, typer.Option(min=1, help="s in which each map is dragged and zoomed.")] = 20.0,
    out: Out = None,
) -> None:
    """Frames and memory of the page in Chromium with a map of 4032 x 4032 cells; each beside its limit.

    Example: zenav bench browser --out browser.json
    """
    from zenav.bench.browser import browser

    raise typer.Exit(browser(out, seconds))


@bench.command("footprint", cls=Command)
def bench_footprint(
    seconds: Annotated[float, typer.Option(min=5, help="s of driving over which CPU is measured.")] = 60.0,
    saved_map: Annotated[
        Path | None, typer.Option("--map", help="Folder of a saved map of the world; none: it is mapped first.")
    ] = None,
    rounds: Annotated[int, typer.Option(min=0, help="Kills of each service.")] = 3,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Memory and CPU of each process of a live stack, its restarts, and how soon it starts; each beside its limit.

    Example: zenav bench footprint --seconds 60 --out footprint.json
    """
    from zenav.bench.footprint import footprint

    raise typer.Exit(footprint(robot, world, seconds, saved_map, rounds, out, set_ or []))


@bench.command("quota", cls=Command)
def bench_quota(
    cores: Annotated[float, typer.Option(min=0.05, max=64, help="Share of one core for all services together.")] = 0.5,
    seconds: Annotated[float, typer.Option(min=30, help="s: give up after this long.")] = 1200.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the world's noise.")] = 0,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """The live scenario in a share of one core, as on a small computer; needs root.

    Example: zenav bench quota --cores 0.5 --set local_ctrl.mppi.rollouts=400 --out quota.json
    """
    from zenav.bench.quota import quota

    raise typer.Exit(quota(robot, world, cores, seconds, seed, out, set_ or []))


@bench.command("soak", cls=Command)
def bench_soak(
    minutes: Annotated[float, typer.Option(min=1, max=600, help="min of the stack's time.")] = 30.0,
    hours: Annotated[float, typer.Option(min=0, max=100, help="h instead of --minutes.")] = 0.0,
    faults: Annotated[float, typer.Option(min=0, help="s between two kills or freezes of a service; 0: none.")] = 0.0,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="On the virtual clock: an hour takes minutes; services are only killed.")
    ] = False,
    against: Annotated[
        Path | None, typer.Option(help="Report of a run without faults: the map must be as good.", metavar="FILE")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the world's noise and of the faults.")] = 0,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """The stack for a long time: what grows, what drifts, and what it does when services die or freeze.

    Example: zenav bench soak --minutes 30 --faults 20 --out soak.json
    """
    from zenav.bench.soak import SoakPlan, soak

    plan = SoakPlan(minutes=60 * hours or minutes, every=faults, seed=seed, lockstep=lockstep, against=against)
    raise typer.Exit(soak(robot, world, plan, out, set_ or []))


@bench.command("plan", cls=Command)
def bench_plan(
    directory: Annotated[
        Path | None,
        typer.Argument(metavar="DIR", help="Folder with movingai/ and ros_maps/; none: $ZENAV_DATA/planning."),
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Scenarios of a map, spread over its buckets.")] = 150,
    out: Out = None,
    robot: RobotName = "x80sv",
) -> None:
    """The planner on maps with known optima and in real buildings: times, lengths, clearance, beside other planners.

    Example: zenav bench plan --limit 150 --out plan.json
    """
    from zenav.bench.plan.report import plan

    raise typer.Exit(plan(directory, limit, robot, out))


@bench.command("serial", cls=Command)
def bench_serial(
    seconds: Annotated[float, typer.Option(min=1, help="s to measure.")] = 20.0,
    out: Out = None,
) -> None:
    """Delays of base_driver between its serial line and the stack, and how fast the hardware decoders are.

    Example: zenav bench serial --seconds 30 --out serial.json
    """
    from zenav.bench.serial import serial

    raise typer.Exit(serial(seconds, out))


@bench.command("gyro", cls=Command)
def bench_gyro(
    directory: Annotated[
        Path | None,
        typer.Argument(metavar="DIR", help="Folder of logs with corrected trajectories; none: simulation alone."),
    ] = None,
    out: Out = None,
) -> None:
    """Odometry's heading with and without gyro, over 100 m of simulated drives and of recorded logs.

    Example: zenav bench gyro $ZENAV_DATA/slam --out gyro.json
    """
    from zenav.bench.gyro import gyro

    raise typer.Exit(gyro(directory, out))


@bench.command("odometry", cls=Command)
def bench_odometry(
    directory: Annotated[
        Path | None,
        typer.Argument(metavar="DIR", help="Folder of the X80SV's recorded drive; none: $ZENAV_DATA/x80sv."),
    ] = None,
    out: Out = None,
) -> None:
    """The real X80SV's recorded wheels through base driver and odometry, against the odometry that it recorded.

    Example: zenav bench odometry --out odometry.json
    """
    from zenav.bench.odometry import odometry

    raise typer.Exit(odometry(directory, out))


@bench.command("slam", cls=Command)
def bench_slam(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder with NAME.log.gz and NAME.relations or NAME.ref.tum.")
    ],
    out: Out = None,
    logs: Annotated[str, typer.Option(help="Only these, separated by commas.", metavar="A,B")] = "",
    registrar: Registrar = "line",
) -> None:
    """Map every log of a folder that has a reference: errors, CPU time and memory; a Markdown table beside the JSON.

    Example: zenav bench slam logs --out slam.json
    """
    from zenav.bench.slam import slam

    raise typer.Exit(slam(directory, [name for name in logs.split(",") if name], out, registrar))


@bench.command("faults", cls=Command)
def bench_faults(
    trials: Annotated[int, typer.Option(min=0, help="Trials; 0: 200, or 50 live.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of phases, noise and world.")] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Trials at a time (not with --live).")] = 1,
    only: Annotated[str, typer.Option(help="Only these faults, separated by commas.", metavar="A,B")] = "",
    out: Out = None,
    live: Annotated[bool, typer.Option("--live", help="As processes over Zenoh, in real time.")] = False,
    robot: RobotName = "x80sv",
) -> None:
    """Break sensors, clocks and services while the robot drives: time to the zero command, distance, reason, resuming.

    Example: zenav bench faults --jobs 2 --out faults.json
    """
    from zenav.bench.faults import faults

    raise typer.Exit(faults(robot, trials or (50 if live else 200), seed, jobs, only, out, live))


@bench.command("figures", cls=Command)
def bench_figures(
    only: Annotated[str, typer.Option(help="Only these rows, separated by commas; see --list.", metavar="A,B")] = "",
    again: Annotated[bool, typer.Option("--again", help="Also what is measured on this code already.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="Show the rows and what is measured; run nothing.")] = False,
    directory: Annotated[
        Path, typer.Option("--dir", help="Folder for the runs; what was interrupted goes on there.", metavar="DIR")
    ] = Path("out/figures"),
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time, of commands that take --jobs.")] = 1,
    data: Annotated[
        Path | None, typer.Option(envvar="ZENAV_DATA", help="Folder of real logs and benchmark worlds.", metavar="DIR")
    ] = None,
) -> None:
    """Rerun the published figures and write them into docs/figures.json, README.md and docs/benchmarks.md; takes hours.

    Example: zenav bench figures --only sim,odometry
    """
    from zenav.bench.figures import figures

    raise typer.Exit(figures(only, again, listed, directory, jobs, data))


@bench.command("fleet", cls=Command)
def bench_fleet(
    robots: Annotated[int, typer.Option(min=1, max=20, help="Robots in the world.")] = 2,
    seconds: Annotated[float, typer.Option(min=5, max=36000, help="s of virtual time.")] = 600.0,
    coordination: Annotated[
        Literal["on", "off", "both"], typer.Option(help="Whether the robots hear each other; both: two runs.")
    ] = "both",
    fault: Annotated[
        Literal["none", "kill_in_door", "partition"],
        typer.Option(help="A robot dies in a narrow place, or the robots hear each other in two halves only."),
    ] = "none",
    seed: Annotated[int, typer.Option(min=0, help="Of world, noise and goals.")] = 0,
    out: Out = None,
    robot: RobotName = "x80sv",
    world: World = "office",
    set_: Setting = None,
) -> None:
    """Several robots drive to random goals in one world: contacts, standstills, goals beside those of one robot.

    Example: zenav bench fleet --robots 4 --seconds 120 --world warehouse
    """
    from zenav.bench.fleet import Coordination, FleetFault, fleet

    kinds = Coordination(coordination), FleetFault(fault)
    raise typer.Exit(fleet(robot, world, robots, seconds, seed, out, set_ or [], *kinds))
