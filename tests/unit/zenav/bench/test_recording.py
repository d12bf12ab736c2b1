# SPDX-License-Identifier: Apache-2.0
"""What the benchmark measures is what it says: the same scans for both, an hour, a runner that only runs."""

from services.mapper.service import MapperService
from shared.codec import decode
from shared.messages import LaserScan
from shared.recording import Recording, Writer, sink
from shared.runners.replay import replay
from shared.service import handlers
from tests.toys import Tiles, eventful
from zenav.bench import recording as bench

SECOND = 1_000_000_000


def test_both_writers_and_both_readers_handle_the_same_scans(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "N_SCANS", 60)
    rows = bench.scans(60)
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
    assert 19.9 < (times[-1] - times[0]) / SECOND < 20.0
    once = [entry.payload for entry in Recording(drive).entries()]
    assert [entry.payload for entry in entries[: 2 * len(once)]] == once + once
    assert Recording(path).indexed


def test_an_idle_service_listens_to_the_same_and_says_nothing(tmp_path):
    idle = bench.idle(MapperService)
    assert handlers(type(idle)).topics.keys() == handlers(MapperService).topics.keys()
    assert len(handlers(type(idle)).ticks) == len(handlers(MapperService).ticks)
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        eventful(sink(writer))
    replayed = replay(Recording(path), ["mapper"], lambda name: bench.idle(Tiles))
    assert replayed.sent["mapper"] == []
    assert any("does not answer request/load_map any more" in gap.what for gap in replayed.gaps)
