# SPDX-License-Identifier: Apache-2.0
"""A recording as Foxglove reads it: the `mcap` package's reader, and messages decoded by the schemas in the file."""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mcap.reader
import numpy as np
import pytest

from shared import topics
from shared.codec import Envelope, decode, encode
from shared.config import UserError
from shared.messages import Journal, LaserScan, Velocity
from shared.recording import Recording, Writer
from tests.disks import no_file_longer_than
from tests.protobuf import schema_of
from zenav.convert.foxglove import to_foxglove

ROOM = Path(__file__).parents[3] / "replay" / "recordings" / "driving.mcap"


def read(path: Path) -> Iterator[tuple[str, Any, dict[str, Any], int]]:
    """(topic, the message's record, what it decodes to, its schema's name) of a file, in order of log time."""
    with path.open("rb") as stream:
        for schema, channel, message in mcap.reader.make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                assert schema.encoding == "jsonschema"
                assert json.loads(schema.data)["type"] == "object"
                found = json.loads(message.data)
            else:
                assert (channel.message_encoding, schema.encoding) == ("protobuf", "protobuf")
                found = schema_of(schema.data).decode(schema.name, message.data)
            yield channel.topic, message, found, schema.name


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "room.mcap"
    shares: list[float] = []
    assert to_foxglove(Recording(ROOM), out, shares.append)[1] == []
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    return out


def test_every_message_of_a_recording_is_there_at_its_time(exported):
    found: dict[str, list[tuple[int, int]]] = {}
    for topic, message, _, _ in read(exported):
        found.setdefault(topic, []).append((message.log_time, message.publish_time))
    recorded: dict[str, list[tuple[int, int]]] = {}
    for entry in Recording(ROOM).entries():
        recorded.setdefault(entry.key, []).append((entry.log_time, entry.sent))
    for key, topic in {
        "scan": "/scan",
        "odom": "/odom",
        "pose": "/pose",
        "plan": "/plan",
        "cmd/nav": "/cmd/nav",
    }.items():
        assert found[topic] == recorded[key]
    n_links = len(recorded["scan"]) + len(recorded["odom"]) + len(recorded["pose"])
    assert len(found["/tf"]) == n_links


def test_scans_and_names_are_what_was_recorded(exported):
    scans = [decode(LaserScan, e.payload)[0] for e in Recording(ROOM).entries(["scan"])]
    schemas = {}
    shown = []
    for topic, _, message, schema in read(exported):
        schemas[topic] = schema
        if topic == "/scan":
            shown.append(message)
    for scan, found in zip(scans, shown, strict=True):
        good = (scan.ranges >= scan.range_min) & (scan.ranges <= scan.range_max)
        np.testing.assert_array_equal(np.array(found["ranges"])[good], scan.ranges[good])
        assert np.isnan(np.array(found["ranges"])[~good]).all()
        assert found["timestamp"]["seconds"] * 10**9 + found["timestamp"]["nanos"] == scan.stamp
    foxglove = {
        "/scan": "LaserScan", "/map": "Grid", "/pose": "PoseInFrame", "/plan": "PosesInFrame", "/tf": "FrameTransforms",
    }  # fmt: skip
    assert {topic: schemas[topic] for topic in foxglove} == {t: f"foxglove.{name}" for t, name in foxglove.items()}


def test_the_map_comes_whole_and_less_often_than_its_tiles(exported):
    maps = [(message.log_time, found) for topic, message, found, _ in read(exported) if topic == "/map"]
    n_updates = Counter(entry.key for entry in Recording(ROOM).entries())["map"]
    assert 2 <= len(maps) < n_updates
    times = [at for at, _ in maps]
    assert min(np.diff(times[:-1])) >= 10**9
    last = maps[-1][1]
    occupied = (
        np.frombuffer(last["data"], np.uint8).reshape(-1, last["column_count"], last["cell_stride"])[:, :, 4] > 64
    )
    assert occupied.sum(axis=0).max() > 20, "a wall of the room is over a metre long"


def test_configuration_and_origin_go_along(exported):
    with exported.open("rb") as stream:
        reader = mcap.reader.make_reader(stream)
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
    recording = Recording(ROOM)
    assert attachment.data == recording.attachments[attachment.name]
    assert metadata.metadata == recording.about


def nothing(share: float) -> None:
    pass


def velocity(writer: Writer, key: str, stamp: int, payload: bytes = b"") -> None:
    payload = payload or encode(Velocity(stamp, 0.1, 0.2, ""), Envelope("guard", "s", stamp, stamp))
    writer.write(key, Velocity, payload, stamp, stamp, stamp)


def test_what_cannot_be_read_is_counted_and_the_rest_is_there(tmp_path):
    with Writer(tmp_path / "a.mcap") as writer:
        velocity(writer, "cmd/vel", 1)
        velocity(writer, "cmd/vel", 2, b"rubbish")
        velocity(writer, "cmd/vel", 3, b"rubbish")
        velocity(writer, "no/such", 4)
        velocity(writer, "cmd/vel", 5)
        writer.write(topics.JOURNAL.key + "/guard", Journal, b"", 6, 6, 0)
    whole = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[: -len(whole) // 10])
    _, notes = to_foxglove(Recording(tmp_path / "a.mcap"), tmp_path / "b.mcap", nothing)
    assert [message.log_time for _, message, _, _ in read(tmp_path / "b.mcap")] == [1, 5]
    assert "2 messages left out on cmd/vel: not msgpack: " in " ".join(notes)
    assert "1 messages left out on no/such: not a topic of this stack" in notes
    assert any("no configuration" in note for note in notes)
    assert any("was not closed" in note for note in notes)


def test_a_recording_of_something_else_is_refused_and_leaves_no_file(tmp_path):
    with Writer(tmp_path / "a.mcap") as writer:
        velocity(writer, "no/such", 4)
    with pytest.raises(UserError, match="holds no message of this stack"):
        to_foxglove(Recording(tmp_path / "a.mcap"), tmp_path / "b.mcap", nothing)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_recording_is_not_written_over_itself(tmp_path):
    (tmp_path / "a.mcap").write_bytes(ROOM.read_bytes())
    with pytest.raises(UserError, match="is the recording itself"):
        to_foxglove(Recording(tmp_path / "a.mcap"), tmp_path / "a.mcap", nothing)


def test_a_full_disk_is_an_error_and_the_old_file_stays(tmp_path):
    out = tmp_path / "b.mcap"
    out.write_bytes(b"old")
    with no_file_longer_than(100_000), pytest.raises(UserError, match="cannot write"):
        to_foxglove(Recording(ROOM), out, nothing)
    assert out.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"]


def test_a_folder_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(UserError, match="cannot write"):
        to_foxglove(Recording(ROOM), tmp_path / "no" / "b.mcap", nothing)
