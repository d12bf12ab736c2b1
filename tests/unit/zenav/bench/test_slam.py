# SPDX-License-Identifier: Apache-2.0
"""The bench takes the logs that have a reference, each in a process of its own, and reports each result."""

import json
import os
from pathlib import Path

import pytest

from shared.config import UserError
from shared.geometry import Pose2
from tests.unit.zenav.logs import room_log
from zenav.__main__ import _status
from zenav.bench.slam import ReferenceLog, map_in_process, map_log, selected_logs, summary


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Logs of a made-up room: `room` with both references, `torn` without a scan, `bare` without a reference."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in ("room", "bare"):
        (folder / f"{name}.log").write_text("\n".join(room_log()) + "\n")
    (folder / "torn.log").write_text("ODOM 1 2 0 0 0 0 1 host 1\n")
    step = Pose2(0.06, 0, 0.1)
    relations = [f"{100 + 0.2 * k:.2f} {100.2 + 0.2 * k:.2f} {step.x} {step.y} {step.yaw}\n" for k in range(39)]
    for name in ("room", "torn"):
        (folder / f"{name}.relations").write_text("# early late dx dy dtheta\n" + "".join(relations))
    (folder / "room.ref.tum").write_text("100 0 0 0 0 0 0 1\n100.2 0.06 0 0 0 0 0.0499792 0.9987503\n")
    return folder


def test_the_figures_stand_in_a_table_in_json_and_in_markdown(folder, capsys):
    assert _status(["bench", "slam", str(folder), "--out", "out/slam.json", "--logs", "room"]) == 0
    shown, told = capsys.readouterr()
    assert "room, relations" in shown
    assert "room: done" in told
    report = json.loads(Path("out/slam.json").read_text())
    figures = report["summary"]["room"]
    assert list(figures["errors"]) == ["relations", "neighbours"]
    assert figures["errors"]["relations"]["n"] == 39
    assert figures["errors"]["relations"]["trans_mean_m"] < 0.02
    assert figures["errors"]["neighbours"]["n"] == 1
    assert figures["scans"] == 40
    assert figures["keyframes"] > 3
    assert figures["memory_mb"] > 50
    assert 0 < figures["scan_ms_median"] <= figures["scan_ms_p99"]
    assert figures["cpu_s"] >= figures["cpu_s_of_jobs"] >= 0
    (picture,) = Path("out").glob("bench-slam-*/room/map.png")
    assert (picture.parent / "trajectory.tum").exists()
    head, line, *rows = Path("out/slam.md").read_text().splitlines()
    assert head.startswith("| log, pairs | n | mean, m |")
    assert set(line) <= set("| -")
    assert [row.split(" | ")[0] for row in rows] == ["| room, relations", "| room, neighbours"]
    assert {row.count("|") for row in (head, line, *rows)} == {head.count("|")}


def test_a_log_that_fails_is_told_and_the_others_go_on(folder, capsys):
    assert _status(["bench", "slam", str(folder), "--out", "slam.json"]) == 1
    assert "torn: " in (told := capsys.readouterr().err)
    assert "no FLASER" in told
    report = json.loads(Path("slam.json").read_text())
    assert list(report["summary"]) == ["room"]
    assert "no FLASER" in report["runs"]["torn"]["trouble"]


def dies(logged, folder, registrar):
    os._exit(1)


def test_a_process_that_dies_takes_no_other_along(folder, monkeypatch):
    monkeypatch.setattr("zenav.bench.slam.map_log", dies)
    assert map_in_process(selected_logs(folder, ["room"])[0], folder / "out") == {"trouble": "its process died"}


def test_a_log_that_the_mapper_cannot_bear_is_told_with_its_error(folder, monkeypatch, capsys):
    monkeypatch.setattr("zenav.slam.offline_slam.offline_slam", lambda log, out, config: {}["lacking"])
    assert map_log(selected_logs(folder, ["room"])[0], folder / "out") == {"trouble": "KeyError('lacking')"}
    assert "Traceback" in capsys.readouterr().err


def test_only_logs_with_a_reference_are_taken(folder):
    (folder / "room.log.gz").write_bytes(b"")
    assert [logged.name for logged in selected_logs(folder)] == ["room", "torn"]
    assert selected_logs(folder, ["room"]) == [
        ReferenceLog("room", folder / "room.log.gz", (folder / "room.relations", folder / "room.ref.tum"))
    ]
    with pytest.raises(UserError, match="no log rom") as error:
        selected_logs(folder, ["rom"])
    assert error.value.hint == "did you mean `room`?"


def test_the_markdown_never_overwrites_the_json(folder):
    assert _status(["bench", "slam", str(folder), "--out", "slam.md"]) == 2


def test_a_summary_is_of_what_the_run_says():
    cpu = {"median": 1.0, "p99": 2.0}
    run = {"errors": {}, "scans": 1, "length_m": 2.0, "cpu_s": 3.0, "cpu_s_of_jobs": 1.0, "cpu_ms_per_scan": cpu}
    run |= {"memory_mb": 4.0, "keyframes": 5, "loops": 6, "states": {"good": 1}}
    assert summary(run)["scan_ms_p99"] == 2.0
    assert "states" not in summary(run)


def test_the_logs_are_mapped_with_the_registrar_that_was_asked_for(folder):
    for registrar in ("line", "kiss"):
        out = f"{registrar}.json"
        assert _status(["bench", "slam", str(folder), "--logs", "room", "--registrar", registrar, "--out", out]) == 0
        report = json.loads(Path(out).read_text())
        assert report["runs"]["room"]["registrar"] == registrar
        assert report["summary"]["room"]["errors"]["relations"]["trans_mean_m"] < 0.02
    assert _status(["slam", "logs/room.log", "--out", "room", "--registrar", "kiss"]) == 0
    assert json.loads(Path("room/report.json").read_text())["registrar"] == "kiss"
