# SPDX-License-Identifier: Apache-2.0
"""Uploads: a recording is at its place whole or not at all, once, with its row, whatever happens on the way."""

import os
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import fsspec
import pytest
from botocore.exceptions import EndpointConnectionError

from shared.recording import Recording, Writer
from tests.replay.record import path_of
from zenav.__main__ import _status
from zenav.batch import s3_store, upload_files, upload_stores, uploading
from zenav.batch.catalogue import Catalogue, table_of
from zenav.batch.storage import Folder
from zenav.batch.upload_files import Uploaded, content_of
from zenav.batch.upload_stores import upload_store
from zenav.batch.uploading import FolderUpload

CHUNK = 100_000  # bytes: a kept recording has four parts
STORES = ("s3", "folder", "memory")
STEPS = (
    (s3_store.S3Store, "_call"), (Folder, "write"), (upload_files, "replace_file"),
    (upload_stores.Pace, "sent"), (upload_stores, "_move_new"), (Catalogue, "add"),
)  # fmt: skip


class KilledError(BaseException):
    """As kill -9: no handler of the code runs."""


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(upload_stores, "CHUNK", CHUNK)
    monkeypatch.setattr(s3_store, "CHUNK", CHUNK)
    monkeypatch.setattr("moto.s3.models.S3_UPLOAD_PART_MIN_SIZE", 1)


@pytest.fixture
def place(request, s3, tmp_path):
    """Makes a URL of an empty place in a store of a kind."""
    s3.mkdir("robots")
    fsspec.filesystem("memory").store.clear()
    numbers = iter(range(10_000))

    def make(kind):
        name = f"{request.node.originalname}-{next(numbers)}"
        return {"s3": f"s3://robots/{name}", "folder": str(tmp_path / name), "memory": f"memory://{name}"}[kind]

    return make


def recordings(folder, *names, source="driving"):
    folder.mkdir(exist_ok=True)
    for name in names:
        shutil.copy(path_of(source), folder / name)
    return folder


def run(folder, url, wait=lambda seconds: None, states=None, events=None, rate=0.0):
    states, events = [] if states is None else states, [] if events is None else events
    store = upload_store(url, rate, wait)
    return FolderUpload(
        folder, ("*.mcap",), store, states.append, lambda level, text: events.append((level, text)), wait
    ).run()


def there(url):
    """The recordings of a place: content by name."""
    folder = Folder(url)
    found = folder.system.glob(f"{folder.path}/*.mcap")
    return {str(path).rsplit("/", 1)[-1]: folder.system.cat_file(path) for path in found}


def rows_of(url):
    table, _ = Catalogue(Folder(url)).read()
    return {} if table is None else {row["recording"].rsplit("/", 1)[-1]: row for row in table.to_pylist()}


@pytest.mark.parametrize("kind", STORES)
def test_each_recording_is_uploaded_once_and_found_without_reading_it(kind, place, tmp_path, capsys):
    url, here = place(kind), recordings(tmp_path / "here", "red-20260101-000000.mcap", "blue-20260101-000000.mcap")
    (here / "blue-20260102-000000.mcap").write_bytes(b"no recording")
    assert run(here, url) == 3
    assert there(url) == {path.name: path.read_bytes() for path in here.glob("*.mcap")}
    assert run(here, url) == 0
    (here / "red-20260101-000000.mcap.uploaded").unlink()
    assert run(here, url) == 1, "its content is there: nothing is sent"
    rows = rows_of(url)
    assert [rows[name]["state"] for name in sorted(rows)] == ["done", "refused", "done"]
    assert _status(["recording", "find", "robot=x80 and driven>0.5", url, "--json"]) == 0
    said = capsys.readouterr()
    assert said.out.count("-20260101-000000.mcap") == 2
    assert said.err == "", "no recording was read"


class Killing:
    """Kills before or after the n-th call of some functions, and counts the calls."""

    def __init__(self, monkeypatch, at, after, functions):
        self.n, self.at, self.after = 0, at, after
        for owner, name in functions:
            monkeypatch.setattr(owner, name, self.wrapped(getattr(owner, name)))

    def wrapped(self, function):
        def step(*args, **options):
            self.n += 1
            if self.n == self.at and not self.after:
                raise KilledError
            result = function(*args, **options)
            if self.n == self.at:
                raise KilledError
            return result

        return step


@pytest.mark.parametrize(
    ("kind", "after"), [("s3", True), ("folder", False), ("folder", True), ("memory", False), ("memory", True)]
)
def test_an_upload_that_is_killed_at_any_step_is_continued_and_never_half_there(kind, after, place, tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    with Writer(here / "x80-20260101-000000.mcap", attachments={"noise": os.urandom(3 * CHUNK)}):
        pass
    content = (here / "x80-20260101-000000.mcap").read_bytes()
    for at in range(1, 40):
        url = place(kind)
        with pytest.MonkeyPatch.context() as patch:
            killing = Killing(patch, at, after, STEPS)
            try:
                run(here, url)
            except KilledError:
                assert set(there(url).values()) <= {content}
            n_steps = killing.n
        run(here, url)
        assert there(url) == {"x80-20260101-000000.mcap": content}
        assert rows_of(url).keys() == {"x80-20260101-000000.mcap"}
        assert sorted(path.name for path in here.iterdir()) == [
            ".uploads.lock", "x80-20260101-000000.mcap", "x80-20260101-000000.mcap.uploaded",
        ]  # fmt: skip
        if n_steps < at:
            return
    pytest.fail("more steps than were tried")


def test_parts_that_are_there_are_not_sent_again(place, tmp_path, monkeypatch):
    url, here = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap")
    sent, call = [], s3_store.S3Store._call

    def counted(self, method, **arguments):
        if method == "upload_part":
            sent.append(arguments["PartNumber"])
            if sent == [1, 2, 3]:
                raise KilledError
        return call(self, method, **arguments)

    monkeypatch.setattr(s3_store.S3Store, "_call", counted)
    with pytest.raises(KilledError):
        run(here, url)
    run(here, url)
    assert sent == [1, 2, 3, 3, 4]


def test_a_copy_that_was_not_checked_before_a_crash_is_checked_after_it(place, tmp_path, monkeypatch):
    """Of a store that gives no checksum: what it was sent is in the metadata, damaged or not."""
    url, here = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap")
    call, called = s3_store.S3Store._call, []

    def flipped_once(self, method, **arguments):
        if method == "head_object" and called[-1:] == ["complete_multipart_upload"]:
            called.append("killed")
            raise KilledError
        called.append(method)
        if called.count("upload_part") == 1 and method == "upload_part":
            arguments["Body"] = arguments["Body"][:-1] + bytes((arguments["Body"][-1] ^ 1,))
        reply = call(self, method, **arguments)
        return {"ETag": reply["ETag"], "ServerSideEncryption": "aws:kms"} if method == "upload_part" else reply

    monkeypatch.setattr(s3_store.S3Store, "_call", flipped_once)
    with pytest.raises(KilledError):
        run(here, url)
    monkeypatch.setattr(s3_store.S3Store, "_call", call)
    run(here, url)
    assert there(url) == {"x80-20260101-000000.mcap": path_of("driving").read_bytes()}
    assert not list(here.glob("*.uploading"))


@pytest.mark.parametrize("says", ["md5", "nothing"])
def test_bytes_that_arrive_damaged_are_sent_again_and_never_stay(says, place, tmp_path, monkeypatch):
    url, here = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap")
    damaged, call, events = [], s3_store.S3Store._call, []

    def flipped(self, method, **arguments):
        if method == "upload_part" and arguments["PartNumber"] == 2 and not damaged:
            damaged.append(True)
            arguments["Body"] = arguments["Body"][:-1] + bytes((arguments["Body"][-1] ^ 1,))
        reply = call(self, method, **arguments)
        if method == "upload_part" and says == "nothing":  # as of a store that encrypts with a key of its own
            return {"ETag": reply["ETag"], "ServerSideEncryption": "aws:kms"}
        return reply

    monkeypatch.setattr(s3_store.S3Store, "_call", flipped)
    run(here, url, events=events)
    assert there(url) == {"x80-20260101-000000.mcap": path_of("driving").read_bytes()}
    assert [level for level, _ in events] == ["WARNING", "INFO"]


@pytest.mark.parametrize("kind", ["folder", "memory"])
def test_damaged_copies_are_written_again(kind, place, tmp_path, monkeypatch):
    url, here, events = place(kind), recordings(tmp_path / "here", "x80-20260101-000000.mcap"), []
    real, lies = upload_stores._sha256, iter(["of other bytes"])
    monkeypatch.setattr(upload_stores, "_sha256", lambda file: next(lies, None) or real(file))
    run(here, url, events=events)
    assert there(url) == {"x80-20260101-000000.mcap": path_of("driving").read_bytes()}
    assert [level for level, _ in events] == ["WARNING", "INFO"]


@pytest.mark.parametrize("kind", STORES)
def test_two_recordings_of_one_name_are_both_kept(kind, place, tmp_path):
    """As of two robots, or of one whose clock began again in 1970."""
    url, name = place(kind), "x80-19700101-000012.mcap"
    for source in ("driving", "killed_service"):
        here = recordings(tmp_path / source, name, source=source)
        os.utime(here / name, ns=(12 * 10**9, 12 * 10**9))
        run(here, url)
    assert set(there(url).values()) == {path_of(s).read_bytes() for s in ("driving", "killed_service")}
    other = f"x80-19700101-000012-{content_of(path_of('killed_service')).sha256[:8]}.mcap"
    assert there(url).keys() == rows_of(url).keys() == {name, other}
    assert run(tmp_path / "killed_service", url) == 0


@pytest.mark.parametrize("kind", STORES)
def test_a_recording_that_was_repaired_replaces_its_copy_and_its_row(kind, place, tmp_path):
    url, here = place(kind), recordings(tmp_path / "here", "x80-20260101-000000.mcap")
    path = here / "x80-20260101-000000.mcap"
    run(here, url)
    shutil.copy(path_of("killed_service"), path)
    os.utime(path, ns=(10**9, 10**9))  # a clock that jumped back
    run(here, url)
    assert there(url) == {path.name: path.read_bytes()}
    (row,) = rows_of(url).values()
    assert (row["sha256"], row["revision"]) == (content_of(path).sha256, 2)


def test_a_recording_that_is_written_waits_until_it_is_closed_or_its_writer_is_dead(place, tmp_path):
    url, here = place("folder"), tmp_path / "here"
    here.mkdir()
    with Writer(here / "x80-20260101-000000.mcap", {"robot": "x80"}):
        os.utime(here / "x80-20260101-000000.mcap", ns=(0, 0))
        assert run(here, url) == 0
    assert run(here, url) == 1
    assert Recording(Path(url) / "x80-20260101-000000.mcap").about["robot"] == "x80"


def test_without_network_it_waits_longer_each_time_and_goes_on_by_itself(place, tmp_path, monkeypatch):
    url, here = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap", "x80-20260102-000000.mcap")
    waits, states, events = [], [], []
    call = s3_store.S3Store._call

    def offline(self, method, **arguments):
        if len(waits) < 12:
            raise OSError("Could not connect")
        return call(self, method, **arguments)

    monkeypatch.setattr(s3_store.S3Store, "_call", offline)
    assert run(here, url, waits.append, states, events) == 2
    bounds = [min(2.0**n, uploading.MAX_WAIT_S) for n in range(12)]
    assert all(bound / 2 <= wait <= bound for wait, bound in zip(waits, bounds, strict=False))
    assert any("Could not connect; tried again in" in state for state in states)
    assert sum(level == "WARNING" for level, _ in events) == 2, "once for each recording"
    assert len(there(url)) == 2


@pytest.mark.parametrize("call", ["exists", "put_file", "open"])
def test_an_error_of_a_library_of_a_store_is_tried_again(call, place, tmp_path, monkeypatch):
    """As of gcsfs: it is no OSError, and the network comes back."""
    url, here, states = place("memory"), recordings(tmp_path / "here", "x80-20260101-000000.mcap"), []
    system, failed = type(Folder(url).system), []
    real = getattr(system, call)

    def offline(self, *args, **options):
        if len(failed) < 2:
            failed.append(call)
            raise EndpointConnectionError(endpoint_url="https://store")
        return real(self, *args, **options)

    monkeypatch.setattr(system, call, offline)
    assert run(here, url, states=states) == 1
    assert sum("Could not connect" in state and "tried again in" in state for state in states) == 2


def test_an_error_while_a_copy_is_read_back_is_tried_again(place, tmp_path, monkeypatch):
    url, here, states = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap"), []
    system = Folder(url).system
    system.pipe_file(f"{url}/x80-20260101-000000.mcap", path_of("driving").read_bytes())  # by another program
    real, failed = type(system).open, []

    def offline(self, *args, **options):
        if not failed:
            failed.append(args)
            raise EndpointConnectionError(endpoint_url="https://store")
        return real(self, *args, **options)

    monkeypatch.setattr(type(system), "open", offline)
    assert run(here, url, states=states) == 1
    assert sum("Could not connect" in state and "tried again in" in state for state in states) == 1


def test_a_part_that_was_removed_meanwhile_leaves_nothing(place, tmp_path, monkeypatch):
    url, here = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap")
    path, call, aborted = here / "x80-20260101-000000.mcap", s3_store.S3Store._call, []

    def removing(self, method, **arguments):
        if method == "upload_part" and arguments["PartNumber"] == 2:
            path.unlink()
            raise OSError("no network")
        if method == "abort_multipart_upload":
            aborted.append(arguments["Key"])
        return call(self, method, **arguments)

    monkeypatch.setattr(s3_store.S3Store, "_call", removing)
    assert run(here, url) == 0
    assert aborted == [f"{url.removeprefix('s3://robots/')}/x80-20260101-000000.mcap"]
    assert [p.name for p in here.iterdir()] == [".uploads.lock"]


def test_the_rate_holds_in_the_mean(place, tmp_path, monkeypatch):
    waits, now = [], [100.0]
    monkeypatch.setattr(upload_stores.time, "monotonic", lambda: now[0])

    def wait(seconds):
        waits.append(seconds)
        now[0] += seconds

    run(recordings(tmp_path / "here", "x80-20260101-000000.mcap"), place("folder"), wait, rate=0.05)
    size = path_of("driving").stat().st_size
    assert sum(waits) == pytest.approx((size - CHUNK) / 50_000)


def test_a_merge_that_is_killed_at_any_step_loses_no_row_and_has_none_twice(tmp_path, monkeypatch):
    monkeypatch.setattr("zenav.batch.catalogue.MAX_ROW_FILES", 5)
    for at in range(1, 20):
        folder = Folder(str(tmp_path / str(at)))
        catalogue = Catalogue(folder)
        for n in range(3):
            catalogue.replace(table_of([{"recording": f"old{n}", "revision": 1, "robot": "x80"}]), [])
        for n in range(6):
            catalogue.add({"recording": f"new{n}", "revision": 1, "error": "x" * 5000})
        catalogue.add({"recording": "old0", "revision": 2, "robot": "red"})
        with pytest.MonkeyPatch.context() as patch, suppress(KilledError):
            killing = Killing(patch, at, False, ((Folder, "write"), (type(folder.system), "rm_file")))
            catalogue.merge()
        table, _ = catalogue.read()
        assert sorted(table["recording"].to_pylist()) == [*(f"new{n}" for n in range(6)), "old0", "old1", "old2"]
        assert {r["recording"]: r["robot"] for r in table.to_pylist()}["old0"] == "red"
        if killing.n < at:
            assert len(folder.names("catalogue")) == 1
            return
    pytest.fail("more steps than were tried")


def test_what_is_beside_a_recording_may_be_damaged(place, tmp_path):
    url, here = place("s3"), recordings(tmp_path / "here", "x80-20260101-000000.mcap")
    (here / "x80-20260101-000000.mcap.uploading").write_bytes(b'{"size": 1')
    (here / "x80-20260101-000000.mcap.uploaded").write_bytes(b"")
    assert run(here, url) == 1
    assert Uploaded.of(here / "x80-20260101-000000.mcap").url == f"{url}/x80-20260101-000000.mcap"


def test_an_entry_that_is_no_file_blocks_no_upload(place, tmp_path):
    url, here = place("folder"), recordings(tmp_path / "here", "a.mcap")
    (here / "folder.mcap").mkdir()
    (here / "loop.mcap").symlink_to("loop.mcap")
    os.mkfifo(here / "pipe.mcap")
    assert run(here, url) == 1
    assert list(there(url)) == ["a.mcap"]


def test_a_folder_is_not_uploaded_to_itself(tmp_path, capsys):
    here = recordings(tmp_path / "here", "a.mcap")
    (tmp_path / "link").symlink_to(here)
    for url in (str(here), str(tmp_path / "link"), f"file://{here}/"):
        assert _status(["recording", "upload", str(here), url]) == 2
        assert "is the place of the uploads itself" in capsys.readouterr().err
    assert [path.name for path in here.iterdir()] == ["a.mcap"]


def test_a_recording_of_a_newer_version_is_uploaded_with_a_refused_row(place, tmp_path):
    url, here = place("folder"), recordings(tmp_path / "here", "a.mcap")
    source = Recording(here / "a.mcap")
    with Writer(here / "newer.mcap", source.about) as writer:
        for entry in source.entries(["odom"], as_recorded=True):
            name = entry.channel.schema_name.rpartition("-")[0] + "-ffffffff"
            writer.copy(replace(entry, channel=replace(entry.channel, schema_name=name)))
    assert run(here, url) == 2
    assert {name: row["state"] for name, row in rows_of(url).items()} == {"a.mcap": "done", "newer.mcap": "refused"}
