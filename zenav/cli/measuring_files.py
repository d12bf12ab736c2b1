# SPDX-License-Identifier: Apache-2.0
"""`zenav bench`: recordings, batches and links. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import Command, Out, RobotName, group

bench = group("Measure: a table here, JSON in a file.")


@bench.command("recording", cls=Command)
def bench_recording(
    hours: Annotated[float, typer.Option(min=0.01, max=10, help="h: length of the made-up recording.")] = 1.0,
    out: Out = None,
) -> None:
    """Reading, writing, opening and replaying recordings, against the mcap package; the recorder's share of a core.

    Example: zenav bench recording --out recording.json
    """
    from zenav.bench.recording import recording as run

    raise typer.Exit(run(hours, out))


@bench.command("gateway", cls=Command)
def bench_gateway(
    seconds: Annotated[float, typer.Option(min=1, max=600, help="s: length of each part.")] = 20.0,
    out: Out = None,
) -> None:
    """The time of a message between services and to a member over TLS; the gateway's CPU and memory.

    As root the member is in a network namespace of its own.

    Example: zenav bench gateway --out gateway.json
    """
    from zenav.bench.gateway import gateway

    raise typer.Exit(gateway(out, seconds))


@bench.command("site", cls=Command)
def bench_site(
    robot: RobotName = "x80sv",
    seconds: Annotated[float, typer.Option(min=5, max=3600, help="s: length of each phase.")] = 30.0,
    cut: Annotated[float, typer.Option(min=5, max=7200, help="s for which the link is cut.")] = 30.0,
    out: Out = None,
) -> None:
    """A robot drives while its link to a site is clear, cut, slow, back and watched: bytes, latency and motion.

    It needs root: the site is in a network namespace behind a link of its own.

    Example: zenav bench site --out site.json
    """
    from zenav.bench.site import site

    raise typer.Exit(site(robot, seconds, cut, out))


@bench.command("ros2", cls=Command)
def bench_ros2(
    seconds: Annotated[float, typer.Option(min=1, max=600, help="s: length of the measurement.")] = 20.0,
    out: Out = None,
) -> None:
    """The time of a message through the bridge to ROS 2, and the bridge's CPU and memory.

    Example: zenav bench ros2 --out ros2.json
    """
    from zenav.bench.ros2 import ros2

    raise typer.Exit(ros2(out, seconds))


@bench.command("batch", cls=Command)
def bench_batch(
    recordings: Annotated[int, typer.Option(min=2, help="Made-up logs.")] = 40,
    scans: Annotated[int, typer.Option(min=2, help="Scans of each.")] = 1000,
    rounds: Annotated[int, typer.Option(min=0, help="Of bare processes and batch in turn; 0: not measured.")] = 3,
    tiny: Annotated[int, typer.Option(min=0, help="Files of the runs that are killed; 0: none.")] = 10_000,
    out: Out = None,
) -> None:
    """What `zenav batch` costs beside bare processes, what a second job gains, and runs that are killed.

    Example: zenav bench batch --rounds 0 --tiny 10000
    """
    from zenav.bench.batch import batch

    raise typer.Exit(batch(out, recordings, scans, rounds, tiny))


@bench.command("archive", cls=Command)
def bench_archive(
    seconds: Annotated[float, typer.Option(min=5, max=3600, help="s: length of the drive.")] = 60.0,
    url: Annotated[str, typer.Option(help="Where to upload to; without: a folder.", metavar="PLACE")] = "",
    rows: Annotated[int, typer.Option(min=1000, max=10_000_000, help="Of the catalogue.")] = 100_000,
    out: Out = None,
) -> None:
    """Bytes of a recording, its upload, CPU time of work on it, and a catalogue of many: for docs/scale.md.

    Example: zenav bench archive --out archive.json
    """
    from zenav.bench.archive import archive

    raise typer.Exit(archive(out, seconds, url, rows))
