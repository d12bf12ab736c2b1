# SPDX-License-Identifier: Apache-2.0
"""`zenav recording`. Only parsing; work is imported when it is due."""

from pathlib import Path
from typing import Annotated

import typer

from zenav.cli.parts import Begin, Command, End, Json, NewRecording, RecordingFile, Recordings, group

recording = group("Look into recordings; repair, cut and join them.")


@recording.command("info", cls=Command)
def recording_info(files: Recordings, as_json: Json = False) -> None:
    """What a recording holds: robot, versions, messages, rates, gaps, what is missed or damaged.

    Example: zenav recording info run.mcap
    """
    from zenav.recording.info import show_info

    raise typer.Exit(show_info(files, as_json))


@recording.command("cat", cls=Command)
def recording_cat(
    file: RecordingFile,
    keys: Annotated[list[str] | None, typer.Argument(metavar="TOPIC...", help="Like scan health/*; none: all.")] = None,
    begin: Begin = None,
    end: End = None,
    number: Annotated[int, typer.Option("--number", "-n", min=0, help="Messages; 0: all.")] = 0,
    attachment: Annotated[str, typer.Option(help="Instead, what is attached, like config.yaml.")] = "",
) -> None:
    """Write messages as JSON, one a line.

    Example: zenav recording cat run.mcap pose cmd/* --begin 10 --end 12.5
    """
    from zenav.recording.cat import cat

    raise typer.Exit(cat(file, keys or [], begin, end, number, attachment))


@recording.command("repair", cls=Command)
def recording_repair(
    file: RecordingFile,
    out: Annotated[Path | None, typer.Option(help="Here, not in its place.", metavar="OUT.mcap")] = None,
) -> None:
    """Rebuild the index of a recording that was not closed or is damaged, and list what is lost.

    Example: zenav recording repair run.mcap
    """
    from zenav.recording.repair import repair

    raise typer.Exit(repair(file, out))


@recording.command("trim", cls=Command)
def recording_trim(
    file: RecordingFile,
    out: NewRecording,
    begin: Begin = None,
    end: End = None,
    topics: Annotated[str, typer.Option(help="Only these, and the journals.", metavar="A,B")] = "",
) -> None:
    """Cut out a time and some topics, so that it still replays.

    Example: zenav recording trim run.mcap --begin 10 --end 70 --out minute.mcap
    """
    from zenav.recording.trim import trim

    raise typer.Exit(trim(file, out, begin, end, [key for key in topics.split(",") if key]))


@recording.command("merge", cls=Command)
def recording_merge(files: Recordings, out: NewRecording) -> None:
    """Join the parts of a recording.

    Example: zenav recording merge run.mcap run.part002.mcap --out whole.mcap
    """
    from zenav.recording.merge import merge

    raise typer.Exit(merge(files, out))


@recording.command("latency", cls=Command)
def recording_latency(
    file: RecordingFile,
    keys: Annotated[list[str] | None, typer.Argument(metavar="TOPIC...", help="Like scan health/*; none: all.")] = None,
    as_json: Json = False,
) -> None:
    """How old messages were when they were recorded, and how long a scan takes to cmd/vel: percentiles, ms.

    Example: zenav recording latency run.mcap scan pose
    """
    from zenav.recording.latency import latency

    raise typer.Exit(latency(file, keys or [], as_json))


@recording.command("stability", cls=Command)
def recording_stability(file: RecordingFile, as_json: Json = False) -> None:
    """How steadily the robot drove: plans that change sides, stops on the way, jerk, turning acceleration.

    Example: zenav recording stability run.mcap
    """
    from zenav.recording.steadiness import stability

    raise typer.Exit(stability(file, as_json))


@recording.command("plot", cls=Command)
def recording_plot(
    file: RecordingFile,
    fields: Annotated[list[str], typer.Argument(metavar="TOPIC:FIELD...", help="Like pose:map_from_base.x")],
    out: Annotated[Path | None, typer.Option(help="A picture, not the terminal.", metavar="OUT.png")] = None,
    begin: Begin = None,
    end: End = None,
) -> None:
    """Draw numbers over time.

    Example: zenav recording plot run.mcap cmd/vel:v odom:v --out v.png
    """
    from zenav.recording.plot import plot

    raise typer.Exit(plot(file, fields, out, begin, end))


@recording.command("mark", cls=Command)
def recording_mark(
    files: Recordings,
    remove: Annotated[bool, typer.Option("--remove", help="Take the mark away.")] = False,
) -> None:
    """Keep recordings from being removed when the recorder's budget is used up.

    Example: zenav recording mark recordings/x80-20261122-101500.mcap
    """
    from zenav.recording.mark import mark

    raise typer.Exit(mark(files, remove))


@recording.command("find", cls=Command)
def recording_find(
    expression: Annotated[str, typer.Argument(help="Like 'contact and duration>60'; '' is all.", metavar="EXPR")],
    place: Annotated[
        str, typer.Argument(help="Folder or URL of recordings, which gets the catalogue too.")
    ] = "recordings",
    jobs: Annotated[int, typer.Option(min=1, help="Recordings that are read at a time.")] = 1,
    refresh: Annotated[
        bool | None,
        typer.Option(
            "--refresh/--as-it-is",
            help="Look for new and removed recordings, or do not; without: where no recorder uploads to.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find recordings by robot, time, distance, contacts, stops and faults: the columns are in docs/batch.md.

    Example: zenav recording find 'robot=red and contact and duration>60' recordings/
    """
    from zenav.batch.finding import find_recordings

    raise typer.Exit(find_recordings(expression, place, jobs, refresh, as_json))


@recording.command("upload", cls=Command)
def recording_upload(
    folder: Annotated[Path, typer.Argument(help="Folder of recordings.", metavar="FOLDER")],
    url: Annotated[str, typer.Argument(help="s3://BUCKET/FOLDER, another URL, or a folder.", metavar="PLACE")],
    rate: Annotated[float, typer.Option(min=0, help="MB/s at most; 0: any.")] = 0.0,
) -> None:
    """Upload what the recorder has not uploaded, as after a drive. It may be interrupted, and goes on from there.

    Example: zenav recording upload recordings/ s3://robots/november
    """
    from zenav.batch.upload_command import upload

    raise typer.Exit(upload(folder, url, rate))


@recording.command("uploads", cls=Command)
def recording_uploads(
    folder: Annotated[Path, typer.Argument(help="Folder of recordings.", metavar="FOLDER")] = Path("recordings"),
    as_json: Json = False,
) -> None:
    """Which recordings of a folder are uploaded, and where; 1 where one is not.

    Example: zenav recording uploads recordings/
    """
    from zenav.batch.upload_command import show_uploads

    raise typer.Exit(show_uploads(folder, as_json))
