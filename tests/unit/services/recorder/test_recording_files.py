# SPDX-License-Identifier: Apache-2.0
"""A recording is fetched in parts: the same bytes, also after an interruption, and never another file."""

import os
from hashlib import sha256

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.recorder.recording_files import listed_recordings, read_part
from shared.config import UserError
from shared.recording_requests import MAX_RECORDING_PART, RecordingPart
from zenav.fleet import site_recordings
from zenav.fleet.site_recordings import fetch_into, patient_ask


def robot(folder, name="a.mcap", fails=()):
    """Answers as a recorder does. fails: numbers of requests that get no reply."""
    asked = []

    def ask(offset, length, digest=False):
        asked.append((offset, length, digest))
        if len(asked) in fails:
            raise UserError("no service answers", "")
        part = read_part(folder, name, offset, length)
        if part is None:
            return RecordingPart(0, False, "no_such_file", name)
        data, hashed, size = part
        return RecordingPart(0, True, "", "", size, b"" if digest else data, hashed)

    return ask, asked


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 300_000), st.integers(0, 300_000), st.booleans())
def test_what_is_fetched_is_the_robots_file_whatever_was_there_before(tmp_path_factory, size, have, is_same):
    folder = tmp_path_factory.mktemp("robot")
    content = os.urandom(size)
    (folder / "a.mcap").write_bytes(content)
    partial = folder / "a.mcap.part"
    partial.write_bytes(content[:have] if is_same else os.urandom(have))
    ask, asked = robot(folder)
    assert fetch_into(partial, ask, lambda done, size: None) == size
    assert partial.read_bytes() == content
    if is_same and 0 < have <= size:
        assert min(offset for offset, _, digest in asked if not digest) == have, "nothing is carried twice"


def test_a_recording_that_grows_faster_than_its_parts_come_ends_where_it_was_and_is_whole_later(tmp_path):
    content = os.urandom(1_000_000)
    (tmp_path / "a.mcap").write_bytes(content[:200_000])
    partial = tmp_path / "a.mcap.part"
    robot_ask, asked = robot(tmp_path)

    def ask(offset, length, digest=False):
        file = tmp_path / "a.mcap"
        file.write_bytes(content[: file.stat().st_size + 2 * length])
        return robot_ask(offset, length, digest)

    n = fetch_into(partial, ask, lambda done, size: None, 200_000)
    assert 200_000 <= n < 200_000 + 2 * MAX_RECORDING_PART
    assert partial.read_bytes() == content[:n]
    (tmp_path / "a.mcap").write_bytes(content)
    asked.clear()
    assert fetch_into(partial, robot_ask, lambda done, size: None) == len(content)
    assert partial.read_bytes() == content
    assert min(offset for offset, _, digest in asked if not digest) == n


def test_what_is_fetched_is_for_its_user_and_group(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"x")
    before = os.umask(0)
    try:
        fetch_into(tmp_path / "out", robot(tmp_path)[0], lambda done, size: None)
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o640


def test_a_fetch_goes_on_after_lost_requests_and_gives_up_in_the_end(tmp_path, monkeypatch):
    (tmp_path / "a.mcap").write_bytes(b"x" * 200_000)
    ask, _ = robot(tmp_path, fails={2, 3})
    out = tmp_path / "out"
    assert fetch_into(out, patient_ask(ask, "red", 0.0), lambda done, size: None) == 200_000
    monkeypatch.setattr(site_recordings, "TRIES", 2)
    ask, _ = robot(tmp_path, fails={1, 2})
    with pytest.raises(UserError):
        fetch_into(tmp_path / "other", patient_ask(ask, "red", 0.0), lambda done, size: None)


def test_a_part_that_was_changed_on_its_way_is_refused(tmp_path):
    def ask(offset, length, digest=False):
        return RecordingPart(0, True, "", "", 3, b"abd", sha256(b"abc").digest())

    with pytest.raises(UserError, match="changed on its way"):
        fetch_into(tmp_path / "out", ask, lambda done, size: None)


@pytest.mark.parametrize(
    "name", ["../secret.mcap", "/etc/passwd", "link.mcap", "folder.mcap", "a.txt", "", "none.mcap"]
)
def test_no_other_file_is_read(tmp_path, name):
    (tmp_path.parent / "secret.mcap").write_bytes(b"secret")
    (tmp_path / "a.txt").write_bytes(b"secret")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "link.mcap").symlink_to(tmp_path.parent / "secret.mcap")
    assert read_part(tmp_path, name, 0, 10) is None
    assert listed_recordings(tmp_path) == []


def test_recordings_are_listed_the_newest_first(tmp_path):
    for n, name in enumerate(("old.mcap", "new.mcap")):
        (tmp_path / name).write_bytes(b"x" * (n + 1))
        os.utime(tmp_path / name, ns=(n, n))
    assert [(row.name, row.size, row.modified) for row in listed_recordings(tmp_path)] == [
        ("new.mcap", 2, 1), ("old.mcap", 1, 0),
    ]  # fmt: skip
    assert listed_recordings(tmp_path / "none") == []
