# SPDX-License-Identifier: Apache-2.0
"""What is written is read; what is damaged gives what is there."""

import signal
import subprocess
import sys
import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import mcap.writer
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from shared import topics
from shared.codec import Envelope, decode, encode
from shared.config import UserError
from shared.messages import Clock, EmergencyStop, LogLine
from shared.recording import CONFIG, Entry, Recording, Writer, about, arithmetic, sink
from shared.schema import schema, schema_id
from tests.disks import no_file_longer_than
from tests.toys import eventful

fast = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

Row = tuple[str, bytes, int]


def lines(n: int, size: int = 20, first: int = 0) -> list[Row]:
    """Log lines that zstd cannot make much smaller: key, payload, time."""
    texts = [f"{(first + i) ** 7:x}" * size for i in range(n)]
    return [
        (f"log/{name}", encode(LogLine(i, "INFO", text), Envelope(name, "s", i, i)), 10 * i)
        for i, text in enumerate(texts)
        for name in (("mapper", "guard")[i % 2],)
    ]


def write(path: Path, rows: list[Row], close: bool = True, flush_each: int = 0) -> Writer:
    writer = Writer(path, {"robot": "x80"}, {CONFIG: b"robot: {}\n"})
    for i, (key, payload, time) in enumerate(rows):
        writer.write(key, LogLine, payload, time, time - 1, i)
        if flush_each and i % flush_each == flush_each - 1:
            writer.flush()
    if close:
        writer.close()
    return writer


def write_on(writer: Writer, rows: list[Row]) -> None:
    for key, payload, time in rows:
        writer.write(key, LogLine, payload, time, time, 0)


def read(path: Path) -> list[Row]:
    return [(e.key, e.payload, e.log_time) for e in Recording(path).entries()]


@dataclass(frozen=True)
class Small:
    """A file of five chunks of 5, 5, 5, 5 and 4 messages, and where each begins and ends."""

    whole: bytes
    rows: list[Row]
    chunks: list[tuple[int, int]]

    def __repr__(self) -> str:
        return "small"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Small:
    path, rows = tmp_path_factory.mktemp("small") / "small.mcap", lines(24)
    write(path, rows, flush_each=5)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    places = [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in summary.chunk_indexes]
    return Small(path.read_bytes(), rows, places)


def test_what_is_written_is_read_in_the_same_order(tmp_path):
    rows = lines(3000)
    write(tmp_path / "a.mcap", rows)
    recording = Recording(tmp_path / "a.mcap")
    entries = list(recording.entries())
    assert [(e.key, e.payload, e.log_time) for e in entries] == rows
    assert [(e.sent, e.sequence) for e in entries] == [(max(t - 1, 0), i) for i, (_, _, t) in enumerate(rows)]
    assert recording.about == {"robot": "x80"}
    assert recording.attachments == {CONFIG: b"robot: {}\n"}
    assert recording.problems == []


def test_some_keys_alone_are_read(tmp_path):
    rows = lines(50)
    write(tmp_path / "a.mcap", rows)
    found = [e.payload for e in Recording(tmp_path / "a.mcap").entries(["log/guard"])]
    assert found == [payload for key, payload, _ in rows if key == "log/guard"]


def test_the_reference_reader_reads_it_with_its_index_and_schemas(tmp_path):
    rows = lines(3000)
    write(tmp_path / "a.mcap", rows)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 3000
        assert max(chunk.uncompressed_size for chunk in summary.chunk_indexes) < 66_000
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        found = list(reader.iter_messages())
    assert [(channel.topic, message.data, message.log_time) for _, channel, message in found] == rows
    assert {(s.name, s.data, c.message_encoding) for s, c, _ in found if s is not None} == {
        (schema_id(LogLine), schema(LogLine), "msgpack")
    }


def test_a_long_recording_needs_no_more_memory_for_its_index_than_the_index_has_bytes(tmp_path):
    keys, n_chunks = [topic.key for topic in topics.TOPICS][:40], 300
    writer = Writer(tmp_path / "a.mcap")
    write_on(writer, [(key, b"x", 0) for key in keys])
    writer.flush()
    tracemalloc.start()
    try:
        for i in range(n_chunks):
            write_on(writer, [(key, b"x", i) for key in keys])
            writer.flush()
        grown = tracemalloc.get_traced_memory()[0] / n_chunks
    finally:
        tracemalloc.stop()
    writer.close()
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert [len(chunk.message_index_offsets) for chunk in summary.chunk_indexes] == [40] * (n_chunks + 1)
    assert grown < 1000  # bytes a chunk, of which the index has 10 for each channel


def test_the_same_input_gives_the_same_file(tmp_path):
    for name in "ab":
        write(tmp_path / name, lines(500), flush_each=40)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_whole_run_is_recorded_as_it_was_published(tmp_path):
    sent: list[Row] = []
    with Writer(tmp_path / "a.mcap") as writer:
        record = sink(writer)
        eventful(lambda s: (record(s), sent.append((s.key, s.payload, s.envelope.sent)))[0])
    assert read(tmp_path / "a.mcap") == sent
    entry: Entry
    for entry in Recording(tmp_path / "a.mcap").entries():
        topic = topics.topic_of(entry.key)
        assert topic is not None
        _, envelope = decode(topic.type, entry.payload)
        assert (envelope.sequence, envelope.sent) == (entry.sequence, entry.sent)


@pytest.mark.parametrize("n_bytes", [-1, 2**64])
def test_times_that_fit_no_file_stop_nothing(tmp_path, n_bytes):
    with Writer(tmp_path / "a.mcap") as writer:
        writer.write("estop", EmergencyStop, b"x", n_bytes, n_bytes, 2**40)
    assert [e.payload for e in Recording(tmp_path / "a.mcap").entries()] == [b"x"]


# --- damage ---------------------------------------------------------------------------------------------------------


def test_a_file_cut_at_any_byte_gives_a_prefix(tmp_path, small):
    path = tmp_path / "cut.mcap"
    for at in range(len(small.whole) - 8):  # before the last magic, behind which nothing is
        path.write_bytes(small.whole[:at])
        if at < 8:
            with pytest.raises(UserError):
                Recording(path)
            continue
        recording = Recording(path)
        found = [(e.key, e.payload, e.log_time) for e in recording.entries()]
        assert found == small.rows[: len(found)]
        n_chunks = sum(end <= at for _, end in small.chunks)
        assert min(5 * n_chunks, 24) <= len(found) <= 5 * (n_chunks + 1)
        assert recording.problems


@pytest.mark.parametrize("compression", list(mcap.writer.CompressionType))
def test_a_chunk_that_the_end_of_the_file_cuts_off_gives_the_messages_before(tmp_path, compression):
    path = tmp_path / "cut.mcap"
    writer = mcap.writer.Writer(str(path), compression=compression, chunk_size=2**24)
    writer.start()
    channel = writer.register_channel("/scan", "cdr", writer.register_schema("sensor_msgs/LaserScan", "ros2msg", b"?"))
    rng = np.random.default_rng(1)  # it does not compress
    payloads = [rng.bytes(2000) for _ in range(1000)]
    for i, payload in enumerate(payloads):
        writer.add_message(channel, i, payload, i)
    writer.finish()
    path.write_bytes(path.read_bytes()[: 2**20])
    recording = Recording(path)
    found = [entry.payload for entry in recording.entries()]
    assert found == payloads[: len(found)]
    assert 350 < len(found) < 530
    assert any("not closed" in problem for problem in recording.problems)
    assert [entry.payload for entry in Recording(path).entries(["/scan"])] == found


@fast
@given(data=st.data())
def test_flipped_bits_cost_what_they_hit_and_never_a_traceback(tmp_path, small, data):
    damaged = bytearray(small.whole)
    for at in data.draw(st.lists(st.integers(0, len(damaged) - 1), min_size=1, max_size=3)):
        damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path / "flipped.mcap"
    path.write_bytes(damaged)
    try:
        found = [e.payload for e in Recording(path).entries()]
    except UserError:
        return
    payloads = iter(payload for _, payload, _ in small.rows)
    assert all(payload in payloads for payload in found)  # a subsequence


@fast
@given(garbage=st.binary(max_size=300), magic=st.booleans())
def test_any_bytes_are_refused_or_read(tmp_path, garbage, magic):
    path = tmp_path / "any.mcap"
    path.write_bytes(mcap.writer.MCAP0_MAGIC + garbage if magic else garbage)
    if not magic:
        with pytest.raises(UserError):
            Recording(path)
        return
    recording = Recording(path)
    assert list(recording.entries()) == []
    assert recording.lives() == {}


@pytest.mark.parametrize(
    ("content", "words"), [(None, "cannot read"), (b"", "is empty"), (b"robot:\n  name: x80\n", "no MCAP")]
)
def test_what_is_no_recording_is_named_with_its_hint(tmp_path, content, words):
    path = tmp_path / "x.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=words) as error:
        Recording(path)
    assert str(path) in error.value.what
    assert error.value.hint


@pytest.mark.parametrize("i_chunk", [0, 1, 4])
def test_a_damaged_chunk_costs_itself_alone(tmp_path, small, i_chunk):
    damaged = bytearray(small.whole)
    damaged[small.chunks[i_chunk][1] - 5] ^= 0xFF
    path = tmp_path / "a.mcap"
    path.write_bytes(damaged)
    recording = Recording(path)
    for _ in range(2):  # reading twice reports once
        rest = small.rows[: 5 * i_chunk] + small.rows[5 * i_chunk + 5 :]
        assert [e.payload for e in recording.entries()] == [payload for _, payload, _ in rest]
    assert len(recording.problems) == 1
    assert "chunk" in recording.problems[0]


def test_messages_whose_channel_is_lost_are_counted(tmp_path, small):
    damaged = bytearray(small.whole[: small.chunks[3][0]])
    damaged[small.chunks[0][1] - 5] ^= 0xFF
    path = tmp_path / "a.mcap"
    path.write_bytes(damaged)
    recording = Recording(path)
    assert list(recording.entries()) == []
    assert sum(problem.startswith("5 messages") for problem in recording.problems) == 2


@pytest.mark.parametrize("compression", list(mcap.writer.CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_files_of_other_writers_are_read(tmp_path, compression, chunked):
    path = tmp_path / "other.mcap"
    writer = mcap.writer.Writer(str(path), compression=compression, use_chunking=chunked)
    writer.start()
    channel = writer.register_channel("/scan", "cdr", writer.register_schema("sensor_msgs/LaserScan", "ros2msg", b"?"))
    for i in range(10):
        writer.add_message(channel, i, bytes([i]), i)
    writer.finish()
    entries = list(Recording(path).entries())
    assert [e.payload for e in entries] == [bytes([i]) for i in range(10)]
    assert entries[0].channel.encoding == "cdr"
    assert entries[0].channel.schema_name == "sensor_msgs/LaserScan"
    with Writer(tmp_path / "copy.mcap") as copy:
        for entry in entries:
            copy.copy(entry)
    assert list(Recording(tmp_path / "copy.mcap").entries()) == entries


# --- the writer's end -----------------------------------------------------------------------------------------------


def test_what_was_flushed_is_read_while_the_writer_lives(tmp_path):
    rows = lines(30)
    writer = write(tmp_path / "a.mcap", rows[:20], close=False, flush_each=20)
    writer.write(rows[20][0], LogLine, rows[20][1], 1, 1, 1)
    assert read(tmp_path / "a.mcap") == rows[:20]
    writer.close()
    assert len(read(tmp_path / "a.mcap")) == 21


def test_what_was_flushed_survives_kill_9(tmp_path):
    code = f"""
from pathlib import Path
from tests.unit.shared.test_recording import lines, write, write_on
rows = lines(200)
writer = write(Path({str(tmp_path / "a.mcap")!r}), rows[:150], close=False, flush_each=50)
write_on(writer, rows[150:])
print("flushed", flush=True)
input()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"flushed\n"
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    recording = Recording(tmp_path / "a.mcap")
    assert [(e.key, e.payload, e.log_time) for e in recording.entries()] == lines(200)[:150]
    assert any("not closed" in problem for problem in recording.problems)


def test_a_full_disk_leaves_what_was_flushed(tmp_path):
    rows = lines(4000)
    with no_file_longer_than(20_000):
        writer = write(tmp_path / "a.mcap", rows[:100], close=False, flush_each=50)
        with pytest.raises(OSError, match="large"):
            write_on(writer, rows[100:])
        writer.close()
    assert read(tmp_path / "a.mcap") == rows[:100]


def test_another_recording_is_never_overwritten_when_asked_so(tmp_path):
    write(tmp_path / "a.mcap", lines(3))
    with pytest.raises(FileExistsError):
        Writer(tmp_path / "a.mcap", exclusive=True)
    assert len(read(tmp_path / "a.mcap")) == 3


def test_two_types_on_one_key_keep_their_schemas(tmp_path):
    with Writer(tmp_path / "a.mcap") as writer:
        writer.write("sim/clock", Clock, b"1", 1, 1, 0)
        writer.write("sim/clock", LogLine, b"2", 2, 2, 1)
        writer.write("sim/clock", Clock, b"3", 3, 3, 2)
    names = [e.channel.schema_name for e in Recording(tmp_path / "a.mcap").entries()]
    assert names == [schema_id(Clock), schema_id(LogLine), schema_id(Clock)]


def test_metadata_names_the_robot_and_the_versions():
    assert about("x80")["robot"] == "x80"
    assert about("x80")["mcap"]
    assert about("x80").items() >= arithmetic().items()
    assert all(arithmetic().values())
