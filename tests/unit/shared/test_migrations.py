# SPDX-License-Identifier: Apache-2.0
"""Old recordings are read as today's, newer ones are refused by their name, and nothing in between is guessed."""

import json
from pathlib import Path

import pytest

from shared import messages
from shared.codec import Envelope, decode, encode, fields_of
from shared.config import UserError
from shared.messages import FollowStatus, Goal, LogLine
from shared.migrations import MIGRATIONS, today, unknown_version
from shared.recording import Channel, Entry, Recording, Writer
from shared.schema import schema, schema_id
from tests.toys import build
from zenav.__main__ import _status
from zenav.replay.reprocess import replay_file

DATA = Path(__file__).parent / "data"
OLD = {
    "FollowStatus-ee5971bf": DATA / "follow-with-solve-time.mcap",
    "Goal-4cd8f1ba": DATA / "goal-with-recovery.mcap",
}
"""By old schema, a recording of its time: made by the stack, cut by zenav recording trim."""


@pytest.mark.parametrize("name", MIGRATIONS)
def test_every_migration_has_an_old_recording_that_it_reads(name):
    recording, type_ = Recording(OLD[name]), MIGRATIONS[name].type
    before = [entry for entry in recording.entries(as_recorded=True) if entry.channel.schema_name == name]
    after = [entry for entry in recording.entries() if entry.key == before[0].key]
    assert len(before) == len(after) > 10
    for old, new in zip(before, after):
        assert (new.log_time, new.sent, new.sequence) == (old.log_time, old.sent, old.sequence)
        assert (new.channel.schema_name, new.channel.schema) == (schema_id(type_), schema(type_))
        message, envelope = decode(type_, new.payload)
        assert envelope.sequence == old.sequence
        assert encode(message, envelope) == new.payload  # as today's stack would have sent it


def test_the_old_progress_is_as_it_was_told():
    entries = list(Recording(OLD["FollowStatus-ee5971bf"]).entries())
    left = [decode(FollowStatus, entry.payload)[0].distance_left for entry in entries]
    assert left[0] == pytest.approx(3.50, abs=0.01)
    assert len(left) == 60


def test_an_old_recovery_is_an_inactive_goal():
    entries = [entry for entry in Recording(OLD["Goal-4cd8f1ba"]).entries() if entry.key == "goal"]
    active = [decode(Goal, entry.payload)[0].active for entry in entries]
    # stand, three goals, and back up, turn, turn and wait with a goal after each; then stand
    assert active == [False, True, True, True, *4 * [False, True], False]


@pytest.mark.parametrize("name", MIGRATIONS)
def test_migrations_lead_to_todays_messages(name):
    assert MIGRATIONS[name].type in today().values()
    assert name != schema_id(MIGRATIONS[name].type)


def test_what_is_no_message_of_the_old_schema_is_left_as_it_is():
    migration = MIGRATIONS["FollowStatus-ee5971bf"]
    for payload in (b"", b"\xc1", b"\x01", b"\x93\x01\x02\x03"):
        assert migration(payload) == payload


def test_copies_keep_the_old_bytes_and_their_schema(tmp_path):
    path = OLD["FollowStatus-ee5971bf"]
    out = tmp_path / "out.mcap"
    assert _status(["recording", "trim", str(path), "--out", str(out)]) == 0
    before, after = (list(Recording(p).entries(as_recorded=True)) for p in (path, out))
    assert [(e.channel, e.payload) for e in before] == [(e.channel, e.payload) for e in after]


def newer(path: Path, name: str, fields: list[str]) -> Path:
    """A recording of two topics, one of them in a version of tomorrow."""
    told = json.dumps({"name": "LogLine", "fields": [{"name": field} for field in fields]}).encode()
    with Writer(path, {"robot": "x80", "commit": "0123abc"}) as writer:
        payload = encode(LogLine(1, "INFO", "x"), Envelope("mapper", "s", 0, 1))
        writer.copy(Entry(Channel("log/mapper", "msgpack", name, "zenav", told), 1, 1, 0, payload))
        writer.write("log/guard", LogLine, payload, 2, 2, 0)
    return path


NEWER = [
    ("LogLine-ffffffff", ["stamp", "level", "text", "colour"], "LogLine-ffffffff; this version knows LogLine-"),
    (schema_id(LogLine), ["stamp", "level", "text", "colour"], "with colour, which this version does not know"),
]


@pytest.mark.parametrize(("name", "fields", "words"), NEWER, ids=["without default", "with default"])
def test_a_newer_recording_is_refused_by_its_name(tmp_path, capsys, name, fields, words):
    path = newer(tmp_path / "a.mcap", name, fields)
    with pytest.raises(UserError, match=words) as error:
        list(Recording(path).entries())
    assert "log/mapper" in error.value.what
    assert "commit 0123abc" in error.value.hint
    with pytest.raises(UserError, match=words):
        replay_file(path, ["mapper"], None, build, lambda done, of: None)
    assert _status(["recording", "cat", str(path)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(("name", "fields"), [row[:2] for row in NEWER])
def test_what_this_version_knows_of_a_newer_recording_is_read(tmp_path, capsys, name, fields):
    path = newer(tmp_path / "a.mcap", name, fields)
    assert [entry.key for entry in Recording(path).entries(["log/guard"])] == ["log/guard"]
    assert _status(["recording", "info", str(path)]) == 0
    assert "another version's" in capsys.readouterr().out
    assert _status(["recording", "repair", str(path)]) == 0
    assert len(list(Recording(path).entries(as_recorded=True))) == 2


@pytest.mark.parametrize("text", [b"", b"[]", b"{}", b'{"fields": 3}', b'{"fields": [3]}', b"\xff", b"[" * 5000])
def test_a_schema_text_that_makes_no_sense_is_not_believed(text):
    assert unknown_version(schema_id(LogLine), text) == ""


def test_every_message_of_today_knows_itself():
    for type_ in today().values():
        assert unknown_version(schema_id(type_), schema(type_)) == ""
    assert "FollowStatus" in today()
    assert messages.Message not in today().values()
    assert fields_of(FollowStatus)
