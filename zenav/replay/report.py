# SPDX-License-Identifier: Apache-2.0
"""`zenav replay`: onto Zenoh, or through services in this process; what people see of it."""

import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from shared.config import RobotFile, UserError, load_robot, nearest
from shared.service import Service
from shared.topics import SERVICES

if TYPE_CHECKING:
    from shared.recording import Recording
    from zenav.replay.comparison import TopicReport
    from zenav.replay.player_clock import PlaybackOptions
    from zenav.replay.reprocess import ReplayReport


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What is asked of services in this process: the options of `zenav replay` by name."""

    through: str = ""
    out: Path | None = None
    settings: tuple[str, ...] = ()
    compare: bool = False
    tolerances: tuple[str, ...] = ()
    against: Path | None = None
    picture: Path | None = None
    pdb: bool = False


def replay(path: Path, robot: str, stack: str, wish: "PlaybackOptions", rerun: ReplayOptions) -> int:
    """`zenav replay`: 0 when it was played, or when what services say is what they said."""
    for file in (path, rerun.against):
        if file is not None and not file.is_file():
            raise UserError(f"there is no recording {file}", "give the path of an .mcap file")
    _check(wish, robot, rerun)
    if rerun.through:
        return _through(path, robot, rerun)
    if rerun.against is not None:
        return _against(path, rerun.against, rerun, None)
    from zenav.replay.player import play

    return play(path, robot, stack, wish)


def _check(wish: "PlaybackOptions", robot: str, rerun: ReplayOptions) -> None:
    """Raises UserError where options do not go together."""
    here = {"--out": rerun.out, "--set": rerun.settings, "--compare": rerun.compare, "--pdb": rerun.pdb}
    given = [name for name, value in here.items() if value]
    if given and not rerun.through and not (given == ["--compare"] and rerun.against):
        raise UserError(f"{given[0]} is for services in this process", "name them: --through odometry,mapper")
    if rerun.tolerances and not (rerun.through or rerun.against):
        raise UserError("--tolerance is for a comparison", "--through services, or --against another recording")
    if rerun.out and rerun.against and rerun.out.exists() and rerun.out.samefile(rerun.against):
        raise UserError(f"{rerun.out} is what is compared with", "choose another --out")
    if rerun.picture and not rerun.against:
        raise UserError("--picture shows two runs", "name the other: --against other.mcap")
    if (rerun.through or rerun.against) and (wish != type(wish)() or (robot and not rerun.through)):
        raise UserError("that is an option of playing onto Zenoh", "leave out --through and --against, or that")


def _through(path: Path, robot: str, rerun: ReplayOptions) -> int:
    from shared.recording import Recording
    from zenav.console.progress import progress_bar
    from zenav.replay.comparison import comparison_lines, tolerances_from
    from zenav.replay.reprocess import replay_file

    recording = Recording(path)
    names = list(dict.fromkeys(name for name in rerun.through.split(",") if name))
    file, tolerances = replay_configuration(recording, names, robot, rerun.settings), tolerances_from(rerun.tolerances)
    begun = time.monotonic()
    with TemporaryDirectory() as folder:
        out = rerun.out or (Path(folder) / "out.mcap" if rerun.against else None)
        try:
            with progress_bar(path.name) as progress:
                report = replay_file(
                    path,
                    names,
                    out,
                    service_builder(file),
                    lambda done, of: progress(done / max(of, 1)),
                    tolerances,
                    file.text if rerun.settings or robot else "",
                )
        except UserError:
            raise
        except Exception as error:
            return print_crash(error, recording, names, rerun.pdb)
        lines = [] if rerun.against else [topic_line(topic) for topic in report.topics]
        lines += comparison_lines(report.topics, report.began) if rerun.compare and not rerun.against else []
        for line in [*lines, *job_lines(report)]:
            sys.stdout.write(f"{line}\n")
        seconds = (report.ended - report.began) / 1e9
        sys.stderr.write(f"{seconds:.1f} s replayed in {time.monotonic() - begun:.1f} s\n")
        for note in report.notes:
            sys.stderr.write(f"{note}\n")
        if rerun.against is not None and out is not None:
            return _against(out, rerun.against, rerun, names)
    return 0 if report.equal else 1


def print_crash(error: Exception, recording: "Recording", names: list[str], debug: bool) -> int:
    """Prints where a service raised, and whether the recording has the same crash. debug: then opens the debugger."""
    from shared.runners.blackbox import crash_in, crash_of

    traceback.print_exception(error)
    then, now = {name: crash_in(recording, name) for name in names}, crash_of(error)
    if now and now in then.values():
        sys.stderr.write(f"{now}: as recorded, the same exception in the same event\n")
    else:
        for name, line in then.items():
            sys.stderr.write(f"{name}: recorded is {line}\n" if line else f"{name}: no crash is recorded\n")
    if debug:
        import pdb

        pdb.post_mortem(error.__traceback__)
    return 1


def _against(path: Path, other: Path, rerun: ReplayOptions, names: list[str] | None) -> int:
    """Two recordings in figures, and message by message. names: of the services whose messages count; None: all."""
    from shared.recording import Recording
    from zenav.metrics.run_metrics import comparison_table, run_differences, run_from_entries, run_metrics
    from zenav.render.map_picture import two_runs
    from zenav.replay.comparison import comparison_lines, tolerances_from
    from zenav.replay.reprocess import compare_files

    first, second = Recording(path), Recording(other)
    a, b = run_from_entries(first.entries()), run_from_entries(second.entries())
    lives = [[life for of_name in recording.lives().values() for life in of_name] for recording in (first, second)]
    was, is_ = run_metrics(b, lives[1]), run_metrics(a, lives[0])
    for line in comparison_table(was, is_, (other.stem[:14], "this"), only_changed=not rerun.compare):
        sys.stdout.write(f"{line}\n")
    if not rerun.compare:
        n_same = sum(was.get(name) == is_.get(name) for name in {*was, *is_})
        sys.stdout.write(f"{n_same} figures are the same (--compare shows them)\n")
    for name, value in run_differences(a, b).items():
        sys.stdout.write(f"{name}: {value:.6g}\n")
    report = compare_files(second, first, names, tolerances_from(rerun.tolerances))
    sys.stdout.write(f"message by message, {other.name} before:\n")
    for topic in report.topics:
        sys.stdout.write(f"{topic_line(topic)}\n")
    if rerun.compare:
        for line in comparison_lines(report.topics, report.began):
            sys.stdout.write(f"{line}\n")
    for note in report.notes:
        sys.stderr.write(f"{note}\n")
    if rerun.picture is not None:
        if a.grid.empty or b.grid.empty or a.grid.resolution != b.grid.resolution:
            raise UserError("there are no two maps of one resolution to draw", "leave out --picture")
        try:
            rerun.picture.write_bytes(two_runs(b.grid, b.trajectory, a.grid, a.trajectory))
        except OSError as error:
            raise UserError(f"cannot write {rerun.picture}: {error.strerror}", "choose another --picture") from None
    return 0 if report.equal else 1


def replay_configuration(recording: "Recording", names: list[str], robot: str, settings: tuple[str, ...]) -> RobotFile:
    """The recorded configuration, or that of `robot`, with what was set otherwise.

    Raises UserError where there is none, or where a setting is none of these services.
    """
    from zenav.recording.opening import recorded_robot_file

    check_services(names, settings)
    file = load_robot(robot) if robot else recorded_robot_file(recording)
    if file is None:
        raise UserError(f"{recording.path} holds no configuration", "name the robot: --robot x80sv")
    if settings or robot:
        apply_settings(file, names, settings)
    return file


def check_services(names: Sequence[str], settings: Sequence[str]) -> None:
    """Raises UserError where a name is no service, or a setting is of a service that is not named."""
    for name in names:
        if name not in SERVICES:
            raise UserError(f"{name} is not a service", nearest(name, SERVICES))
    for assignment in settings:
        section = assignment.partition(".")[0].strip()
        if section in SERVICES and section not in names:
            raise UserError(
                f"--set {assignment}: {section} is not replayed", f"--through {','.join([*names, section])}"
            )


def apply_settings(file: RobotFile, names: Sequence[str], settings: Sequence[str]) -> None:
    """Sets what was set otherwise in a robot's file, and reads it for some services. Raises UserError."""
    from zenav.stack.config_report import read_sections

    for assignment in settings:
        file.override(assignment)
    read_sections(file, tuple(names))


def job_lines(report: "ReplayReport") -> list[str]:
    """A line a kind of job: how many, how late their results came then, how long they take here."""
    kinds: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for job in report.jobs:
        kinds.setdefault((job.name, job.done), []).append(((job.ended - job.ordered) / 1e9, job.spent))
    lines = []
    for (name, done), rows in sorted(kinds.items()):
        late, spent = (sorted(column) for column in zip(*rows, strict=True))
        lines.append(
            f"{name} {done}: {len(rows)} jobs, after {late[len(late) // 2]:.3f} s (at most {late[-1]:.3f}) then, "
            f"{spent[len(spent) // 2]:.3f} s (at most {spent[-1]:.3f}) of work here"
        )
    return lines


def topic_line(topic: "TopicReport") -> str:
    """A topic's row: how many messages are as recorded, and what is not."""
    counts = {"equal": topic.n_equal, "different": topic.n_different, "lacking": topic.n_lacking, "new": topic.n_new}
    counts |= {"within tolerance": topic.n_within} if topic.n_within else {}
    counts |= {"after the last journal": topic.n_beyond} if topic.n_beyond else {}
    return f"{topic.key:<16}" + "".join(f" {n:>8} {word}" for word, n in counts.items()) + f" {topic.first}".rstrip()


def service_builder(file: RobotFile) -> Callable[[str], Service]:
    """Makes services by name from a robot's file."""
    from zenav.stack.service_loader import build_service

    robot = file.robot
    return lambda name: build_service(name, file, robot)
