# SPDX-License-Identifier: Apache-2.0
"""Bags that were cut off, flipped or lost their index: intact messages are read, and losses are reported."""

import sqlite3
import subprocess
import sys
from functools import cache
from io import BytesIO

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from shared.config import UserError
from tests.unit.zenav.convert.bags import file_of, small
from zenav.convert.content import Choice
from zenav.convert.export import convert
from zenav.convert.records import LoggedScan
from zenav.convert.ros_files import RESCUES, kind_of, read_bag
from zenav.convert.ros_messages import WANTED
from zenav.convert.source import read_log

STORED = "ros1", "ros1-lz4", "mcap", "mcap-zstd", "sqlite"
FUZZ = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@cache
def content_of(kind, folder):
    """A small bag's one file, as bytes; or a recording of the stack with the same in it."""
    if kind == "zenav":
        out = folder / "whole.mcap"
        convert(small().write(folder / "source"), out, "", Choice(), "", False)
        return out.read_bytes()
    return file_of(small(kind).write(folder / f"whole-{kind}")).read_bytes()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("bags")


def scans_of(path):
    """(stamp, ranges) of each scan that can be read, and what was said."""
    log = read_log(path, Choice())
    scans = [(r.stamp, tuple(r.ranges.tolist())) for r in log.records if isinstance(r, LoggedScan)]
    return scans, [*log.notes, *(["bad messages"] if log.n_bad else [])]


def unless_refused(read, otherwise):
    """What is read, or `otherwise` after an error in one line with its hint. Any other exception is the test's."""
    try:
        return read()
    except UserError as error:
        refused = error
    assert refused.what
    assert "\n" not in refused.what
    assert refused.hint
    return otherwise


@cache
def whole(kind, folder):
    """The scans of the sound bag."""
    path = folder / f"{kind}.bag"
    path.write_bytes(content_of(kind, folder))
    return scans_of(path)[0]


@pytest.mark.parametrize("kind", STORED)
def test_what_is_rescued_of_a_sound_bag_is_all_that_rosbags_reads(kind, folder, tmp_path):
    path = tmp_path / "bag"
    path.write_bytes(content_of(kind, folder))
    messages, lost = RESCUES[kind_of(path)](path)
    assert sorted(m for m in messages if m.type in WANTED) == sorted(read_bag(path, WANTED).messages)
    assert lost == []


@pytest.mark.parametrize("kind", [*STORED, "zenav"])
@FUZZ
@given(data=st.data())
def test_a_bag_that_was_cut_off_gives_what_came_before(kind, folder, data):
    """Each scan that comes out is one that went in; that some are missing is said."""
    content = content_of(kind, folder)
    size = data.draw(st.integers(0, len(content) - 1))
    path = folder / f"cut-{kind}.bag"
    path.write_bytes(content[:size])
    scans, told = unless_refused(lambda: scans_of(path), ([], ["refused"]))
    assert set(scans) <= set(whole(kind, folder))
    assert told


@pytest.mark.parametrize("kind", [*STORED, "zenav"])
@FUZZ
@given(data=st.data())
def test_a_bag_with_flipped_bits_is_read_or_refused_in_a_line(kind, folder, data):
    content = bytearray(content_of(kind, folder))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path = folder / f"flipped-{kind}.bag"
    path.write_bytes(content)
    unless_refused(lambda: read_log(path, Choice()), None)


@pytest.mark.parametrize("kind", ["ros1", "ros1-lz4", "mcap", "mcap-zstd", "sqlite"])
def test_most_of_what_is_left_of_a_long_drive_is_saved(kind, tmp_path):
    path = file_of(small(kind, n=300).write(tmp_path / "bag"))
    content = path.read_bytes()
    marks = {"ros1": b"op=\x04", "mcap": b"\x07" + (22).to_bytes(8, "little")}  # where the index begins
    end = content.index(marks[kind[:4]]) if kind[:4] in marks else len(content)
    path.write_bytes(content[: end * 3 // 4])
    scans, told = scans_of(path)
    assert 100 < len(scans) < 300
    assert told


def test_bytes_lost_in_the_middle_of_a_ros1_bag_cost_the_messages_around_them(tmp_path):
    path = small("ros1", n=40).write(tmp_path / "bag")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 3] + content[len(content) // 3 + 5 :])
    scans, told = scans_of(path)
    assert 37 <= len(scans) < 41
    assert any("bytes in" in note for note in told)


@pytest.mark.parametrize("kind", ["ros1-lz4", "ros1-bz2"])
def test_a_damaged_first_chunk_costs_itself(kind, tmp_path):
    """It alone has the topics; the index at the file's end has them again."""
    path = small(kind, n=1500).write(tmp_path / "bag")
    content = bytearray(path.read_bytes())
    first = content.index(b"compression=") + 100
    content[first : first + 100] = bytes(100)
    path.write_bytes(content)
    scans, told = scans_of(path)
    assert 300 < len(scans) < 1500
    assert any("1 chunks do not unpack" in note for note in told)


def test_a_chunk_with_an_unknown_compression_is_told(tmp_path):
    path = small("ros1-lz4").write(tmp_path / "bag")
    path.write_bytes(path.read_bytes().replace(b"compression=lz4", b"compression=xyz"))
    with pytest.raises(UserError, match="'xyz' is not supported; 1 chunks do not unpack to their end") as error:
        read_log(path, Choice())
    assert error.value.hint


def in_chunks(path, size):
    """An MCAP file's content, by the format's own package, in chunks as small as a robot's recorder makes them."""
    out = BytesIO()
    writer = Writer(out, chunk_size=size)
    writer.start(profile="ros2", library="test")
    channels = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
    writer.finish()
    return out.getvalue()


def test_an_mcap_chunk_that_is_damaged_costs_itself(tmp_path):
    path = file_of(small("mcap", n=100).write(tmp_path / "bag"))
    content = bytearray(in_chunks(path, 16384))
    content[content.index(b"\x28\xb5\x2f\xfd", len(content) // 3) + 200] ^= 255  # within the zstd frame
    path.write_bytes(content)
    scans, told = scans_of(path)
    assert 60 < len(scans) < 100
    assert any("chunk" in note for note in told)


@pytest.mark.parametrize("part", ["the folder", "its file"])
def test_a_compressed_bag_that_finds_no_room_is_refused_in_a_line(part, tmp_path, monkeypatch):
    bag = small("mcap-file").write(tmp_path / "bag")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.mkdtemp", full)
    with pytest.raises(UserError, match="No space left") as error:
        read_log(bag if part == "the folder" else file_of(bag), Choice())
    assert "TMPDIR" in error.value.hint


def test_an_mcap_file_of_something_else_says_of_what(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        schema = writer.register_schema("foxglove.Grid", "jsonschema", b"{}")
        channel = writer.register_channel("/grid", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(UserError, match="1 messages are json, not ROS's"):
        read_log(path, Choice())


def test_what_a_killed_recorder_had_not_brought_into_its_database_is_read_too(tmp_path):
    path = file_of(small("sqlite").write(tmp_path / "bag"))
    code = (
        "import sqlite3, os, sys\n"
        "c = sqlite3.connect(sys.argv[1]); c.execute('PRAGMA journal_mode=WAL')\n"
        "rows = list(c.execute('SELECT topic_id, timestamp, data FROM messages'))\n"
        "c.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)', rows)\n"
        "c.commit(); os._exit(9)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert path.with_name(path.name + "-wal").stat().st_size
    scans, _ = scans_of(path)
    assert len(scans) == 16


def test_a_database_without_topics_is_refused(tmp_path):
    path = tmp_path / "a.db3"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE songs (name TEXT)")
    connection.commit()
    connection.close()
    with pytest.raises(UserError, match=r"a\.db3"):
        read_log(path, Choice())
