# SPDX-License-Identifier: Apache-2.0
"""What the benchmark measures is what it says: the same scans for both, an hour, a runner that only runs."""

import pytest

from services.mapper.service import MapperService
from shared.codec import decode
from shared.messages import LaserScan
from shared.recording import Recording, Writer, sink
from shared.runners.replay import replay
from shared.service import handlers
from shared.types import NS_PER_S
from tests.toys import Tiles, eventful
from zenav.bench import recording as bench


def test_both_writers_and_both_readers_handle_the_same_scans(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "N_SCANS", 60)
    rows = bench.scan_rows(60)
    ours, peers = tmp_path / "ours.mcap", tmp_path / "peers.mcap"
    bench.write_ours(ours, rows)
    bench.write_peers(peers, rows)
    for path in (ours, peers):
        assert [(e.payload, e.log_time) for e in Recording(path).entries()] == rows
        bench.read_ours(path)
        bench.read_peers(path)
    scan, _ = decode(LaserScan, rows[-1][0])
    assert len(scan.ranges) == bench.N_BEAMS


def test_the_hour_is_the_drive_again_and_again(tmp_path):
    drive, path = tmp_path / "drive.mcap", tmp_path / "hour.mcap"
    with Writer(drive) as writer:
        eventful(sink(writer))
    n = bench.make_hour(drive, path, 20 / 3600)
    entries = list(Recording(path).entries())
    assert len(entries) == n
    times = [entry.log_time for entry in entries]
    assert 19.9 < (times[-1] - times[0]) / NS_PER_S < 20.0
    once = [entry.payload for entry in Recording(drive).entries()]
    assert [entry.payload for entry in entries[: 2 * len(once)]] == once + once
    assert Recording(path).indexed


def test_an_idle_service_listens_to_the_same_and_says_nothing(tmp_path):
    idle = bench.idle_service(MapperService)
    assert handlers(type(idle)).topics.keys() == handlers(MapperService).topics.keys()
    assert len(handlers(type(idle)).ticks) == len(handlers(MapperService).ticks)
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        eventful(sink(writer))
    replayed = replay(Recording(path), ["mapper"], lambda name: bench.idle_service(Tiles))
    assert replayed.sent["mapper"] == []
    assert any("does not answer request/load_map any more" in gap.what for gap in replayed.gaps)


GOOD = {
    "written_a_second": 37_000, "read_a_second": 124_000, "open_s": 0.05, "seek_s": 0.005, "info_s": 0.1,
    "mapper_times_real_time": 50.0, "replay_times_real_time": 179.0, "recorder_share": 0.04, "recorder_missed": 0,
}  # fmt: skip
RATES = {"write": "written_a_second", "read": "read_a_second"}


def test_every_figure_at_its_limit_is_kept():
    assert all(bench.within_limits(GOOD).values())


@pytest.mark.parametrize(
    ("name", "worse"),
    [
        ("written_a_second", 19_999), ("read_a_second", 49_999), ("open_s", 1.01), ("seek_s", 1.01), ("info_s", 1.01),
        ("mapper_times_real_time", 49.9), ("replay_times_real_time", 49.9), ("recorder_share", 0.051),
        ("recorder_missed", 1),
    ],
)  # fmt: skip
def test_a_figure_beyond_its_limit_is_not_kept_whatever_the_others_are(name, worse):
    kept = bench.within_limits({**GOOD, name: worse})
    assert [key for key, holds in kept.items() if not holds] == [name]


@pytest.mark.parametrize(("ratio", "own_ratio", "status"), [(50.0, 56.0, 0), (17.1, 18.9, 1)])
def test_a_slow_mapper_does_not_lower_the_limit_of_its_replay(ratio, own_ratio, status, tmp_path, monkeypatch, capsys):
    scans = {"bytes": 3030} | {name: {"ours": GOOD[key], "mcap": 9, "ratio": 9.0} for name, key in RATES.items()}
    replayed = {"ratio": ratio, "own_ratio": own_ratio, "runner_ratio": 179}
    recorder = {"share": 0.04, "bare_share": 0.04, "ratio": 1.0, "messages_a_second": 480.0, "missed": 0}
    hour = dict.fromkeys(("hours", "messages", "mb", "open_s", "seek_s", "info_s", "command_s"), 0.5)
    monkeypatch.setattr(bench, "new_run_folder", lambda _: tmp_path)
    monkeypatch.setattr(bench, "drive", lambda *_: None)
    for name, figures in (("scan", scans), ("replay", replayed), ("recorder", recorder), ("hour", hour)):
        monkeypatch.setattr(bench, f"_{name}_figures", lambda *_, figures=figures: figures)
    assert bench.recording(1.0, None) == status
    row = next(line for line in capsys.readouterr().out.splitlines() if "replay with the mapper" in line)
    assert row.split("least")[1].split() == ["50", f"{ratio:g}", *(["not", "kept"] if status else ["kept"])]
