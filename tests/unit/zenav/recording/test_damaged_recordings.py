# SPDX-License-Identifier: Apache-2.0
"""Damaged files through every command and the replay: an answer or one line of error, never a traceback."""

from contextlib import suppress
from pathlib import Path

import mcap.writer
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.codec import Envelope, encode
from shared.config import UserError
from shared.messages import LogLine
from shared.recording import CONFIG, Recording, Writer, sink
from shared.runners.lockstep import Lockstep
from tests.toys import ROBOT, build
from zenav.__main__ import _status
from zenav.recording.info import recording_info
from zenav.replay.reprocess import replay_file

slow = settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


class Written(bytes):
    """Of a file; an example that fails shows where it was damaged, and not this."""

    def __repr__(self) -> str:
        return "small"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of a few chunks, with journals, of two services that ran for 1.2 s."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    with Writer(path, {"robot": ROBOT.name}, {CONFIG: b"robot: {}\n"}) as writer:
        record, n = sink(writer), 0

        def take(sent):
            nonlocal n
            record(sent)
            n += 1
            if n % 30 == 0:
                writer.flush()

        lockstep = Lockstep({name: build(name) for name in ("base_driver", "odometry")}, take)
        lockstep.run(1.2)
        lockstep.flush()
    return Written(path.read_bytes())


def survived(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every command says something of the file; what repair makes of it has nothing wrong."""
    damaged = path.read_bytes()
    for command in ("info", "cat", "latency"):
        assert _status(["recording", command, str(path)]) in (0, 1, 2)
    out = path.with_name("repaired.mcap")
    out.unlink(missing_ok=True)
    if _status(["recording", "repair", str(path), "--out", str(out)]) in (0, 1):
        whole = Recording(out)
        assert whole.indexed
        assert [e.payload for e in whole.entries(as_recorded=True)] == [
            e.payload for e in Recording(path).entries(as_recorded=True)
        ]
        assert whole.damage == []
    else:
        assert not out.exists()
    assert path.read_bytes() == damaged
    for line in capsys.readouterr().err.splitlines():
        assert "Traceback" not in line
    with suppress(UserError):
        replay_file(path, ["odometry"], None, build, lambda done, of: None)


def test_a_file_cut_in_its_head_or_its_index_is_survived(small, tmp_path, capsys):
    path = tmp_path / "cut.mcap"
    for at in (*range(0, 60, 5), *range(len(small) - 40, len(small), 5)):
        path.write_bytes(small[:at])
        survived(path, capsys)


@slow
@given(at=st.integers(0, 2**20))
def test_a_file_cut_anywhere_is_survived(small, tmp_path, capsys, at):
    path = tmp_path / "cut.mcap"
    path.write_bytes(small[: at % len(small)])
    survived(path, capsys)


@slow
@given(flips=st.lists(st.tuples(st.integers(0, 2**20), st.integers(0, 7)), min_size=1, max_size=4))
def test_flipped_bits_are_survived(small, tmp_path, capsys, flips):
    damaged = bytearray(small)
    for at, bit in flips:
        damaged[at % len(damaged)] ^= 1 << bit
    path = tmp_path / "flipped.mcap"
    path.write_bytes(damaged)
    survived(path, capsys)


@slow
@given(at=st.integers(0, 2**20), n=st.integers(1, 400), value=st.integers(0, 255))
def test_a_stretch_of_one_byte_is_survived(small, tmp_path, capsys, at, n, value):
    damaged = bytearray(small)
    begin = at % len(damaged)
    damaged[begin : begin + n] = bytes([value]) * len(damaged[begin : begin + n])
    path = tmp_path / "flat.mcap"
    path.write_bytes(damaged)
    survived(path, capsys)


def test_info_survives_a_file_without_compression_wherever_it_is_cut(tmp_path):
    """As of ROS 2: the channel of a message may be there, and the message not."""
    path = tmp_path / "ros.mcap"
    writer = mcap.writer.Writer(str(path), compression=mcap.writer.CompressionType.NONE)
    writer.start("ros2", "rosbag2")
    number = writer.register_schema("std_msgs/msg/String", "ros2msg", b"?")
    for i, key in enumerate(("/a", "/b")):
        writer.add_message(writer.register_channel(key, "cdr", number), i, b"x" * 20, i, 0)
    writer.finish()
    content, counts = path.read_bytes(), set()
    for at in range(10, len(content)):
        path.write_bytes(content[:at])
        counts.add(tuple(row.n for row in recording_info(path).topics))
    assert counts == {(), (0,), (1,), (1, 0), (1, 1)}


def test_a_tail_of_zeros_as_a_power_failure_leaves_it_is_told_and_repaired(small, tmp_path, capsys):
    path, whole = tmp_path / "zeros.mcap", tmp_path / "whole.mcap"
    whole.write_bytes(small)
    path.write_bytes(small[: len(small) // 2] + bytes(5000))
    expected = [e.payload for e in Recording(whole).entries()]
    found = [e.payload for e in Recording(path).entries()]
    assert found == expected[: len(found)]
    assert len(found) > 20
    assert any("make no sense" in p or "not closed" in p for p in Recording(path).problems)
    survived(path, capsys)


def test_a_chunk_whose_length_is_damaged_costs_itself_alone(small, tmp_path):
    """Without an index a wrong length misleads the walk: it finds the next chunk by its signature."""
    path = tmp_path / "a.mcap"
    path.write_bytes(small)
    blocks, expected = Recording(path).blocks, [e.payload for e in Recording(path).entries()]
    for length in (7, 2**62, blocks[1].length + 40):
        damaged = bytearray(small[: blocks[-1].place + blocks[-1].length])
        damaged[blocks[1].place - 8 : blocks[1].place] = length.to_bytes(8, "little")
        path.write_bytes(damaged)
        recording = Recording(path)
        found = [e.payload for e in recording.entries()]
        lost = len(expected) - len(found)
        assert lost <= 40  # its messages, or none: its end is stated inside too
        payloads = iter(expected)
        assert all(payload in payloads for payload in found)
        assert recording.damage


@pytest.mark.parametrize("times", [[5, 4, 3, 2, 1], [10, 2**63, 5, 2**64 - 1, 6], [10**18, 10**18 - 10**15, 10**18]])
def test_unsorted_times_and_a_clock_that_jumps_are_survived(tmp_path, capsys, times):
    path = tmp_path / "a.mcap"
    with Writer(path) as writer:
        for i, time in enumerate(times):
            payload = encode(LogLine(i, "INFO", "x"), Envelope("mapper", "s", i, i))
            writer.write("log/mapper", LogLine, payload, time, i, i)
    assert [e.log_time for e in Recording(path).entries()] == times
    survived(path, capsys)
    out = tmp_path / "out.mcap"
    assert _status(["recording", "trim", str(path), "--out", str(out)]) == 0
    assert [e.log_time for e in Recording(out).entries()] == times


@pytest.mark.parametrize("content", [b"", b"robot:\n  name: x80\n", b"\x89MCAP0\r\n", b"\0" * 4096])
@pytest.mark.parametrize("command", ["info", "cat", "latency", "repair", "mark", "trim", "plot"])
def test_what_is_no_recording_is_told_in_one_line(tmp_path, capsys, content, command):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    more = {"trim": ["--out", str(tmp_path / "y.mcap")], "plot": ["cmd/vel:v"]}.get(command, [])
    status = _status(["recording", command, str(path), *more])
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    if content == b"\x89MCAP0\r\n" and command not in ("latency", "plot"):
        assert status in (0, 1)  # an MCAP file in which nothing is
    else:
        assert status == 2
        assert err.count("\n") == 2
