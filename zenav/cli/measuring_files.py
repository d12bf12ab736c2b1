# SPDX-License-Identifier: Apache-2.0
"""`zenav bench`: recordings, batches and links. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import Command, Out, group

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
    rounds: Annotated[int, typer.Option(min=1, help="Of bare processes and batch in turn.")] = 3,
    files: Annotated[int, typer.Option(min=4, help="Files of the run that is killed.")] = 10_000,
    out: Out = None,
) -> None:
    """What `zenav batch` costs beside bare processes, what a second job gains, and a run that is killed.

    Example: zenav bench batch --out batch.json
    """
    from zenav.bench.batch import batch

    raise typer.Exit(batch(out, recordings, scans, rounds, files))
