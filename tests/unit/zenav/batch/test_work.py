# SPDX-License-Identifier: Apache-2.0
"""What of a batch's work is kept, and what is refused before any recording is read."""

import pytest

from shared.config import UserError, robot_path
from zenav.__main__ import _status
from zenav.batch import work
from zenav.batch.child_process import TryLimits
from zenav.batch.commands import batch
from zenav.batch.storage import Folder, sources
from zenav.batch.table import last_table
from zenav.batch.work import ReplayWork, SlamWork, process, result_key


def refusing(behind: Exception | None):
    def run(asked, path):
        try:
            if behind is not None:
                raise behind
        except OSError:
            raise UserError("cannot write out.mcap", "free the disk") from None
        raise UserError(f"{path} holds no scan", "take another log")

    return run


def test_a_fault_of_the_disk_is_tried_again_and_a_refused_recording_is_not(tmp_path, monkeypatch):
    (tmp_path / "a.log").write_text("no log")
    source, out = sources([str(tmp_path / "a.log")])[0], str(tmp_path / "out")
    monkeypatch.setitem(work._RUN, SlamWork, refusing(OSError(28, "No space left on device")))
    rows = [process(SlamWork(), out, "code", source) for _ in range(2)]
    assert [(row["state"], row["cached"]) for row in rows] == [("failed", False), ("failed", False)]
    monkeypatch.setitem(work._RUN, SlamWork, refusing(None))
    rows = [process(SlamWork(), out, "code", source) for _ in range(2)]
    assert [(row["state"], row["cached"]) for row in rows] == [("refused", False), ("refused", True)]


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (ReplayWork(("maper",)), "maper is not a service"),
        (ReplayWork(("mapper",), settings=("guard.margin=1",)), "guard is not replayed"),
        (ReplayWork(("mapper",), robot="x99"), "there is no robot x99"),
        (ReplayWork(("mapper",), robot="x80sv", settings=("mapper.nothing=1",)), "nothing"),
    ],
)
def test_what_is_wrong_for_every_recording_is_told_before_the_first(tmp_path, asked, words):
    (tmp_path / "a.mcap").write_bytes(b"no recording")
    with pytest.raises(UserError, match=words):
        batch(asked, [str(tmp_path)], str(tmp_path / "out"), 1, "", TryLimits(), "", False)
    assert not (tmp_path / "out").exists()


def test_an_edited_file_of_a_robot_gives_other_keys(tmp_path, monkeypatch):
    robot, asked = tmp_path / "red.yaml", []
    monkeypatch.setattr("zenav.batch.commands.batch", lambda work, *rest: asked.append(work) or 0)
    for text in (robot_path("x80sv").read_text(), robot_path("x80sv").read_text() + "\n# edited\n"):
        robot.write_text(text)
        assert _status(["batch", "replay", "a.mcap", "--out", "o", "--through", "mapper", "--robot", str(robot)]) == 0
    assert len({result_key("a", work, "code") for work in asked}) == 2


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff"])
def test_a_damaged_result_or_table_counts_as_none(tmp_path, monkeypatch, capsys, content):
    (tmp_path / "a.log").write_text("no log")
    source, out = sources([str(tmp_path / "a.log")])[0], tmp_path / "out"
    monkeypatch.setitem(work._RUN, SlamWork, refusing(None))
    first = process(SlamWork(), str(out), "code", source)
    (out / "results" / first["key"] / "row.json").write_bytes(content)
    assert not process(SlamWork(), str(out), "code", source)["cached"]
    assert process(SlamWork(), str(out), "code", source)["cached"]
    (out / "table.parquet").write_bytes(content)
    assert last_table(Folder(str(out))) == []
    assert "table.parquet is damaged" in capsys.readouterr().err
