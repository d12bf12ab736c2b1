# SPDX-License-Identifier: Apache-2.0
"""`zenav batch` against a server of S3."""

import pytest

from shared.config import UserError
from tests.unit.zenav.logs import room_log
from zenav.batch.child_process import TryLimits
from zenav.batch.commands import batch
from zenav.batch.storage import Folder
from zenav.batch.table import last_table
from zenav.batch.work import SlamWork, result_key

OUT = "s3://results/today"


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


def test_the_key_depends_on_input_configuration_and_code():
    asked = [("a", SlamWork(), "1"), ("b", SlamWork(), "1"), ("a", SlamWork("kiss"), "1"), ("a", SlamWork(), "2")]
    keys = {result_key(*one) for one in asked}
    assert len(keys) == 4
    assert result_key("a", SlamWork(), "1") in keys


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr("zenav.batch.cluster_extra.find_spec", lambda name: None)
    with pytest.raises(UserError) as error:
        slam("logs")
    assert error.value.hint == 'pip install "zenav[cluster]"'


def test_without_credentials_or_connection_it_is_one_line(s3, monkeypatch):
    import s3fs

    for name, value, words in (
        ("AWS_ENDPOINT_URL", "http://127.0.0.1:9", "Could not connect"),
        ("AWS_ACCESS_KEY_ID", "", "locate credentials"),
    ):
        monkeypatch.setenv(name, value)
        monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
        monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
        s3fs.S3FileSystem.clear_instance_cache()
        with pytest.raises(UserError, match=words) as error:
            slam("s3://logs/*.log")
        assert error.value.hint
