# SPDX-License-Identifier: Apache-2.0
"""`zenav batch`: many recordings. Only parsing; work is imported when it is due."""

from typing import Annotated

import typer

from zenav.cli.parts import BaseFrame, Command, OdomFrame, Registrar, Setting, TopicOdom, TopicScan, group

batch = group("One work over many recordings, here or on a cluster: a table, and what changed since the last run.")

Inputs = Annotated[list[str], typer.Argument(help="Paths, URLs and globs of recordings.", metavar="PLACE...")]
OutFolder = Annotated[str, typer.Option("--out", help="Folder or URL for table and results.", metavar="PLACE")]
Jobs = Annotated[int, typer.Option(min=1, help="Recordings at a time on this computer.")]
Cluster = Annotated[str, typer.Option(help="A Dask scheduler, in place of this computer.", metavar="tcp://HOST:PORT")]
Timeout = Annotated[float, typer.Option(min=0, help="s that one recording may take; 0: any.")]
Memory = Annotated[float, typer.Option(min=0, help="MB that one recording may take; 0: any.")]
Tries = Annotated[int, typer.Option(min=1, max=10, help="Times that a recording is tried whose process dies.")]
Against = Annotated[
    str, typer.Option(help="Compare with the --out of an earlier run, or with a revision.", metavar="PLACE|REVISION")
]
FailWorse = Annotated[bool, typer.Option("--fail-worse", help="Status 1 where a recording became worse.")]


@batch.command(cls=Command)
def slam(
    inputs: Inputs,
    out: OutFolder,
    jobs: Jobs = 1,
    cluster: Cluster = "",
    timeout: Timeout = 0.0,
    memory: Memory = 0.0,
    tries: Tries = 2,
    against: Against = "",
    fail_worse: FailWorse = False,
    registrar: Registrar = "line",
    topic_scan: TopicScan = "",
    topic_odom: TopicOdom = "",
    base_frame: BaseFrame = "",
    odom_frame: OdomFrame = "",
) -> None:
    """Make the map of each log, as `zenav slam` does. A log whose map is there already is not computed again.

    Example: zenav batch slam logs/ --out results --jobs 2
    """
    from zenav.batch.child_process import TryLimits
    from zenav.batch.commands import batch as run
    from zenav.batch.work import SlamWork

    work = SlamWork(registrar, topic_scan, topic_odom, base_frame, odom_frame)
    limits = TryLimits(timeout, round(memory * 1e6), tries)
    raise typer.Exit(run(work, inputs, out, jobs, cluster, limits, against, fail_worse))


@batch.command(cls=Command)
def replay(
    inputs: Inputs,
    out: OutFolder,
    through: Annotated[list[str], typer.Option(help="A service of today; may be repeated.", metavar="SERVICE")],
    jobs: Jobs = 1,
    cluster: Cluster = "",
    timeout: Timeout = 0.0,
    memory: Memory = 0.0,
    tries: Tries = 2,
    against: Against = "",
    fail_worse: FailWorse = False,
    robot: Annotated[str, typer.Option("--robot", help="Whose configuration to take; else the recorded.")] = "",
    set_: Setting = None,
) -> None:
    """Run each recording through services of today, as `zenav replay` does, and count what differs.

    Example: zenav batch replay recordings/ --through mapper --out results
    """
    from shared.config import load_robot
    from zenav.batch.child_process import TryLimits
    from zenav.batch.commands import batch as run
    from zenav.batch.work import ReplayWork

    work = ReplayWork(tuple(through), robot, tuple(set_ or []), load_robot(robot).text if robot else "")
    limits = TryLimits(timeout, round(memory * 1e6), tries)
    raise typer.Exit(run(work, inputs, out, jobs, cluster, limits, against, fail_worse))
