# SPDX-License-Identifier: Apache-2.0
"""`zenav bench recording`: how fast recordings are written, read, opened and replayed, and what the recorder costs.

Rates are of CPU time, medians of runs in turn with the peer's: the `mcap` package's writer and reader, on the same
scans. The drive is the stack's own, in lockstep; the hour is that drive again and again, at the rates of the stack.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import IO, Any, cast

import mcap.writer
import numpy as np
import psutil
from mcap.reader import make_reader

from shared.codec import Envelope, encode
from shared.config import UserError
from shared.messages import LaserScan
from shared.recording import Entry, Recording, Writer
from shared.runners.replay import Build, Replayed, replay
from shared.schema import schema, schema_id
from shared.service import Service, every, handlers, on
from shared.types import NS_PER_S
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.progress import progress_bar
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.console.table import show_table
from zenav.recording.info import recording_info
from zenav.recording.opening import recorded_robot_file
from zenav.replay.report import service_builder
from zenav.scenario.lockstep_run import run_lockstep as drive
from zenav.scenario.scenario import load_scenario
from zenav.stack.launch import Launcher, free_stack, service_command
from zenav.stack.service_loader import service_class

N_SCANS, N_BEAMS, RATE = 20_000, 720, 40.0
REPEATS = 5
CHUNK_BYTES = 64 * 1024
DRIVE = 40.0  # s
FLUSH_EACH = 450  # messages: about a second of the stack
START = 60.0  # s that the recorder may take to answer
MINIMUM, MAXIMUM = "at least", "at most"
LIMITS: dict[str, tuple[str, str, float]] = {
    "written_a_second": ("scans written a second of CPU", MINIMUM, 20_000),
    "read_a_second": ("scans read a second of CPU", MINIMUM, 50_000),
    "open_s": ("open an hour, s", MAXIMUM, 1.0),
    "seek_s": ("seek in it, s", MAXIMUM, 1.0),
    "info_s": ("info of it, s", MAXIMUM, 1.0),
    "mapper_times_real_time": ("replay with the mapper, times real time", MINIMUM, 50),
    "replay_times_real_time": ("replay without the mapper's work, times real time", MINIMUM, 50),
    "recorder_share": ("recorder, share of a core", MAXIMUM, 0.05),
    "recorder_missed": ("recorder, messages missed", MAXIMUM, 0),
}
"""What is required of each figure of the summary. The limits are fixed: none follows another figure of the run."""

ScanRow = tuple[bytes, int]
"""A scan's bytes and time, ns."""


def recording(hours: float, out: Path | None) -> int:
    """Measures, shows and writes the figures; 0 when every limit is kept."""
    check_writable(out)
    logs = new_run_folder("recording")
    with tempfile.TemporaryDirectory() as name, stop_on_signal() as stop, progress_bar("recording") as progress:
        folder = Path(name)
        report: dict[str, Any] = {"scans": _scan_figures(folder)}
        progress(0.2)
        driven = folder / "drive.mcap"
        drive(load_scenario("x80sv", "office", 0, []), DRIVE, driven)
        progress(0.4)
        report["replay"] = _replay_figures(driven)
        progress(0.5)
        report["recorder"] = _recorder_figures(driven, logs, folder / "live.mcap", stop)
        if stop.is_set():
            return 130
        progress(0.7)
        report["hour"] = _hour_figures(driven, folder / "hour.mcap", hours)
        progress(1.0)
    report["summary"] = {
        "written_a_second": report["scans"]["write"]["ours"],
        "read_a_second": report["scans"]["read"]["ours"],
        "open_s": report["hour"]["open_s"],
        "seek_s": report["hour"]["seek_s"],
        "info_s": report["hour"]["info_s"],
        "mapper_times_real_time": report["replay"]["ratio"],
        "replay_times_real_time": report["replay"]["runner_ratio"],
        "recorder_share": report["recorder"]["share"],
        "recorder_missed": report["recorder"]["missed"],
    }
    show_figures(report)
    write_report(out, report)
    return 0 if all(within_limits(report["summary"]).values()) else 1


def within_limits(summary: dict[str, float]) -> dict[str, bool]:
    """Whether each figure of the summary keeps its limit."""
    return {
        name: summary[name] >= limit if side == MINIMUM else summary[name] <= limit
        for name, (_, side, limit) in LIMITS.items()
    }


# --- scans ----------------------------------------------------------------------------------------------------------


def _scan_figures(folder: Path) -> dict[str, Any]:
    rows = scan_rows()
    ours, peers = folder / "ours.mcap", folder / "peers.mcap"
    return {
        "bytes": len(rows[0][0]),
        "write": _rates({"ours": lambda: write_ours(ours, rows), "mcap": lambda: write_peers(peers, rows)}),
        "read": _rates({"ours": lambda: read_ours(ours), "mcap": lambda: read_peers(ours)}),
        "size_ratio": round(ours.stat().st_size / peers.stat().st_size, 3),
    }


def scan_rows(n: int = N_SCANS) -> list[ScanRow]:
    """Sweeps of a room with a laser's noise, rounded to the mm as lasers do."""
    rng, rows = np.random.default_rng(0), []
    room = 4 + 2 * np.sin(np.arange(N_BEAMS) / 50)
    for i in range(n):
        at = round(i * NS_PER_S / RATE)
        ranges = (room + rng.normal(0, 0.01, N_BEAMS)).round(3).astype(np.float32)
        scan = LaserScan(
            stamp=at,
            angle_min=-np.pi,
            angle_increment=2 * np.pi / N_BEAMS,
            scan_time=1 / RATE,
            range_min=0.05,
            range_max=12.0,
            ranges=ranges,
        )
        rows.append((encode(scan, Envelope("sim", "bench", i, at)), at))
    return rows


def _rates(calls: dict[str, Callable[[], None]]) -> dict[str, float]:
    """Scans a second of CPU, medians of runs in turn; ratio: ours to the peer's, of each round."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(REPEATS):
        for name, call in calls.items():
            begun = time.process_time()
            call()
            seconds[name].append(time.process_time() - begun)
    rates: dict[str, float] = {name: round(N_SCANS / median(took)) for name, took in seconds.items()}
    ratios = [peer / own for own, peer in zip(seconds["ours"], seconds["mcap"])]
    return rates | {"ratio": round(median(ratios), 2)}


def write_ours(path: Path, rows: list[ScanRow]) -> None:
    with Writer(path) as writer:
        for i, (payload, at) in enumerate(rows):
            writer.write("scan", LaserScan, payload, at, at, i)


def write_peers(path: Path, rows: list[ScanRow]) -> None:
    with path.open("wb") as file:
        writer = mcap.writer.Writer(cast(IO[Any], file), chunk_size=CHUNK_BYTES)
        writer.start()
        number = writer.register_schema(schema_id(LaserScan), "zenav", schema(LaserScan))
        channel = writer.register_channel("scan", "msgpack", number)
        for i, (payload, at) in enumerate(rows):
            writer.add_message(channel, at, payload, at, i)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap's own


def read_ours(path: Path) -> None:
    n = sum(len(entry.payload) > 0 for entry in Recording(path).entries())
    if n != N_SCANS:
        raise RuntimeError(f"{n} of {N_SCANS} scans were read")


def read_peers(path: Path) -> None:
    with path.open("rb") as file:
        n = sum(len(message.data) > 0 for _, _, message in make_reader(file).iter_messages())
    if n != N_SCANS:
        raise RuntimeError(f"{n} of {N_SCANS} scans were read")


# --- the drive ------------------------------------------------------------------------------------------------------


def _replay_figures(path: Path) -> dict[str, float]:
    """The mapper in process, on its journal: seconds of the drive a CPU second, its second time round."""
    recording = Recording(path)
    file = recorded_robot_file(recording)
    if file is None:
        raise RuntimeError("the drive has no configuration")
    events = [event for life in recording.lives()["mapper"] for event in life.events]
    seconds = (events[-1].now - events[0].now) / NS_PER_S
    _, (took, replayed) = (
        _timed(recording, service_builder(file)),
        _timed(recording, service_builder(file)),
    )  # the first loads the kernels
    if replayed.gaps:
        raise RuntimeError(f"the drive does not replay: {replayed.gaps[0]}")
    runner, _ = _timed(recording, lambda name: idle_service(service_class(name)))
    return {
        "seconds": round(seconds, 1), "cpu_s": round(took, 3), "runner_cpu_s": round(runner, 3),
        "ratio": round(seconds / took, 1), "own_ratio": round(seconds / max(took - runner, 1e-9), 1),
        "runner_ratio": round(seconds / runner),
    }  # fmt: skip


def _timed(recording: Recording, build: Build) -> tuple[float, Replayed]:
    begun = time.process_time()
    replayed = replay(recording, ["mapper"], build)
    return time.process_time() - begun, replayed


def idle_service(class_: type[Service]) -> Service:
    """A service that listens to what this one does, and does nothing: what is left is the runner's own work."""
    marked = handlers(class_)
    methods: dict[str, Any] = {name: on(topic)(lambda self, message: ()) for topic, name in marked.topics.values()}
    methods |= {name: every(hz)(lambda self: ()) for hz, name, _ in marked.ticks}
    idle_type: Any = type("Idle", (Service,), methods)
    return cast(Service, idle_type(None, None))


def _recorder_figures(path: Path, logs: Path, live: Path, stop: StopFlag) -> dict[str, float]:
    """The recorder's process while the drive is published at its own pace: its share of a core, and what it missed.

    Shares are medians of the drive's parts, as other load comes and goes; ratio: the recorder's to the bare
    subscriber's, of each part.
    """
    entries = [entry for entry in Recording(path).entries() if not entry.key.endswith("/recorder")]
    zero = entries[0].log_time
    with free_stack() as claim, Client("x80", claim.where) as client, subscriber(claim.where.domain) as bare:
        command = service_command("recorder", "x80sv", str(claim.where.domain), [f"recorder.file={live}"])
        with Launcher({"recorder": command}, logs) as launcher:
            health_keys: list[str] = []
            client.listen_raw("health/recorder", lambda key, _: health_keys.append(key))
            launcher.start_all()
            limit = time.monotonic() + START
            while not health_keys and not stop.is_set():
                if time.monotonic() > limit:
                    raise UserError("the recorder does not answer", f"see {logs}/recorder.log")
                stop.wait(0.1)
                launcher.step()
            child = launcher.children["recorder"].process
            process = psutil.Process(child.pid if child else 0)
            begun = time.monotonic()
            seen = [(begun, _cpu(process), _cpu(bare))]
            for entry in entries:
                late = begun + (entry.log_time - zero) / NS_PER_S - time.monotonic()
                if late > 0 and stop.wait(late):
                    break
                client.session.put(f"x80/{entry.key}", entry.payload)
                if time.monotonic() - begun >= len(seen) * DRIVE / REPEATS:
                    seen.append((time.monotonic(), _cpu(process), _cpu(bare)))
            wall = time.monotonic() - begun
            stop.wait(1.5)  # it flushes twice a second
    recording = Recording(live)
    n = sum(not entry.key.endswith("/recorder") for entry in recording.entries())
    parts = [(cpu / took, bare_cpu / took) for took, cpu, bare_cpu in np.diff(seen, axis=0)]
    shares, bare_shares = zip(*(parts or [(0.0, 0.0)]))
    return {
        "messages_a_second": round(len(entries) / wall, 1), "share": round(float(median(shares)), 4),
        "bare_share": round(float(median(bare_shares)), 4),
        "ratio": round(float(median(own / max(peer, 1e-9) for own, peer in zip(shares, bare_shares))), 2),
        "missed": len(entries) - n if not stop.is_set() else 0,
    }  # fmt: skip


BARE = """
import sys
from shared.runners.transport import stack_address
from zenav.client import Client
with Client("x80", stack_address(sys.argv[1])) as client:
    client.listen_raw("**", lambda key, payload: None)
    sys.stdin.read()
"""


@contextmanager
def subscriber(domain: int) -> Iterator[psutil.Process]:
    """A process that is called with everything and does nothing with it: what Zenoh's callbacks alone take."""
    with subprocess.Popen([sys.executable, "-c", BARE, str(domain)], stdin=subprocess.PIPE) as process:
        try:
            yield psutil.Process(process.pid)
        finally:
            process.kill()


def _cpu(process: psutil.Process) -> float:
    """s of CPU that it has taken."""
    times = process.cpu_times()
    return float(times.user + times.system)


# --- the hour -------------------------------------------------------------------------------------------------------


def _hour_figures(driven: Path, path: Path, hours: float) -> dict[str, float]:
    """Times, s, of a long recording: its opening, a seek into its middle, its info; each once."""
    n = make_hour(driven, path, hours)
    begun = time.perf_counter()
    recording = Recording(path)
    opened = time.perf_counter() - begun
    blocks = recording.blocks
    middle = (blocks[0].begin + blocks[-1].end) // 2
    begun = time.perf_counter()
    next(recording.entries(["scan"], middle))
    sought = time.perf_counter() - begun
    begun = time.perf_counter()
    info = recording_info(path)
    informed = time.perf_counter() - begun
    if info.messages != n:
        raise RuntimeError(f"info counts {info.messages} of {n} messages")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "zenav", "recording", "info", str(path)], stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "hours": hours, "messages": n, "mb": round(path.stat().st_size / 1e6, 1), "open_s": round(opened, 3),
        "seek_s": round(sought, 4), "info_s": round(informed, 3), "command_s": round(wall, 2),
        "command_cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 2),
    }  # fmt: skip


def make_hour(driven: Path, path: Path, hours: float) -> int:
    """The drive again and again; the number of messages. Payloads stay: their stamps are the drive's."""
    entries = list(Recording(driven).entries(as_recorded=True))
    zero, length = entries[0].log_time, entries[-1].log_time - entries[0].log_time + NS_PER_S // 50
    n, shift = 0, 0
    with Writer(path, {"robot": "x80"}) as writer:
        while shift < hours * 3600 * NS_PER_S:
            for entry in entries:
                at = entry.log_time + shift
                if at - zero >= hours * 3600 * NS_PER_S:
                    break
                writer.copy(Entry(entry.channel, at, entry.sent + shift, entry.sequence, entry.payload))
                n += 1
                if n % FLUSH_EACH == 0:
                    writer.flush()
            shift += length
    return n


# --- shown ----------------------------------------------------------------------------------------------------------


def show_figures(report: dict[str, Any]) -> None:
    """The figures as tables."""
    rates = [
        (f"{kind}, scans/s of CPU", f"{row['ours']:.0f}", f"{row['mcap']:.0f}", f"{row['ratio']:.2f}")
        for kind, row in (("write", report["scans"]["write"]), ("read", report["scans"]["read"]))
    ]
    show_table(f"scans of {N_BEAMS} beams, {report['scans']['bytes']} bytes", ("", "ours", "mcap", "ratio"), rates)
    hour, live, again = report["hour"], report["recorder"], report["replay"]
    title = f"a recording of {hour['hours']:g} h: {hour['messages']} messages, {hour['mb']:.0f} MB"
    rows = [(name, f"{hour[f'{name}_s']:.3f}") for name in ("open", "seek", "info")]
    show_table(title, ("s", ""), [*rows, ("info as a command, with its start", f"{hour['command_s']:.2f}")])
    show_table(
        "the drive",
        ("", ""),
        [
            ("mapper replayed, times real time", f"{again['ratio']:.1f}"),
            ("the mapper's own speed", f"{again['own_ratio']:.1f}"),
            ("the replay's own speed", f"{again['runner_ratio']:.0f}"),
            ("recorder, % of a core", f"{live['share'] * 100:.1f}"),
            ("a callback that does nothing, % of a core", f"{live['bare_share'] * 100:.1f}"),
            ("ratio", f"{live['ratio']:.2f}"),
            ("recorder, messages a second", f"{live['messages_a_second']:.0f}"),
            ("recorder, messages missed", f"{live['missed']}"),
        ],
    )
    holds = within_limits(report["summary"])
    show_table(
        "limits",
        ("", "", "limit", "measured", ""),
        [
            (what, side, f"{limit:g}", f"{report['summary'][name]:g}", "kept" if holds[name] else "not kept")
            for name, (what, side, limit) in LIMITS.items()
        ],
    )
