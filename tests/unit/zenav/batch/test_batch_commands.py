# SPDX-License-Identifier: Apache-2.0
"""`zenav batch` against a server of S3."""

from urllib.request import urlopen

import pytest

from shared.config import UserError
from tests.unit.zenav.logs import room_log
from zenav.batch.child_process import TryLimits
from zenav.batch.commands import batch
from zenav.batch.storage import Folder
from zenav.batch.table import last_table
from zenav.batch.work import SlamWork, result_key

OUT = "s3://results/today"


@pytest.fixture
def s3(monkeypatch):
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    urlopen(f"http://{host}:{port}/moto-api/reset", data=b"").close()  # its buckets outlive a server
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://{host}:{port}"), ("AWS_ACCESS_KEY_ID", "test"),
        ("AWS_SECRET_ACCESS_KEY", "test"), ("AWS_DEFAULT_REGION", "us-east-1"),
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    files = s3fs.S3FileSystem()
    files.mkdir("logs")
    files.mkdir("results")
    yield files
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def slam(*inputs, against=""):
    return batch(SlamWork(), list(inputs), OUT, 1, "", TryLimits(), against, False)


def room(n):
    return "\n".join(room_log(n)).encode()


def test_only_what_changed_is_computed_again_and_what_cannot_be_read_is_named(s3, capsys):
    s3.pipe({"logs/a.log": room(40), "logs/b.log": room(30), "logs/c.log": b"no log at all\n"})
    assert slam("s3://logs/*.log") == 1
    first = {row["recording"]: row for row in last_table(Folder(OUT))}
    assert [row["state"] for row in first.values()] == ["done", "done", "refused"]
    assert "s3://logs/c.log" in first["s3://logs/c.log"]["error"]
    assert first["s3://logs/a.log"]["scans_placed"] == 40
    assert s3.cat(f"results/today/results/{first['s3://logs/a.log']['key']}/map.png").startswith(b"\x89PNG")

    s3.pipe("logs/b.log", room(35))
    s3.rm("logs/c.log")
    capsys.readouterr()
    assert slam("s3://logs/*.log") == 0
    second = {row["recording"]: row for row in last_table(Folder(OUT))}
    assert {url: row["cached"] for url, row in second.items()} == {"s3://logs/a.log": True, "s3://logs/b.log": False}
    assert second["s3://logs/a.log"]["digest"] == first["s3://logs/a.log"]["digest"]
    assert "2 recordings, 1 of them computed by an earlier run" in capsys.readouterr().out
    assert len(s3.ls("results/today/runs", refresh=True)) == 2
    assert b"s3://logs/b.log" in s3.cat("results/today/changes.html")


def test_an_input_or_a_former_run_that_is_not_there_is_one_line(s3):
    with pytest.raises(UserError, match=r"s3://logs/\*\.log names no recording"):
        slam("s3://logs/*.log")
    s3.pipe("logs/a.log", room(3))
    with pytest.raises(UserError, match="holds no table of a batch"):
        slam("s3://logs/a.log", against="s3://results/never")


def test_the_key_depends_on_input_and_configuration():
    keys = {result_key("a", SlamWork()), result_key("b", SlamWork()), result_key("a", SlamWork("kiss"))}
    assert len(keys) == 3
    assert result_key("a", SlamWork()) in keys


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("zenav.batch.cluster_extra.find_spec", lambda name: None)
    with pytest.raises(UserError) as error:
        slam("logs")
    assert error.value.hint == 'pip install "zenav[cluster]"'
