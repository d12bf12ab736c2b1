# SPDX-License-Identifier: Apache-2.0
"""`zenav bench odometry` on the real X80SV's drive, and on one that is not the same."""

import csv
import gzip
import json
import os
import shutil
from math import pi
from pathlib import Path

import pytest

from shared.config import UserError
from zenav.bench.odometry import MAX_DISTANCE, MAX_TURN, integration_errors, odometry, table_numbers

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251
needs_data = pytest.mark.skipif(DATA is None, reason="ZENAV_DATA names no real logs")
COUNT = 2 * pi / 756


def drive(folder: Path, change=lambda row: row) -> Path:
    """The recorded drive with other rows of wheels (t s, left rad, right rad)."""
    real = Path(DATA) / "x80sv"
    shutil.copy(real / "odom.csv.gz", folder)
    with gzip.open(folder / "wheel_positions.csv.gz", "wt", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("t", "left", "right"))
        writer.writerows(change(row) for row in table_numbers(real / "wheel_positions.csv.gz"))
    return folder


@needs_data
def test_the_real_robot_s_drive_is_within_the_limits_by_its_driver_s_integration_alone(tmp_path, capsys):
    assert odometry(Path(DATA) / "x80sv", tmp_path / "o.json") == 0
    report = json.loads((tmp_path / "o.json").read_text())
    assert report["summary"]["integration"] == "document"
    assert report["summary"]["distance_max_m"] < MAX_DISTANCE
    assert report["summary"]["turn_max_deg"] < MAX_TURN
    assert all(row["seconds"] > 273 for row in report["rows"].values())
    exact = [row for name, row in report["rows"].items() if name.startswith("exact")]
    assert min(row["distance_max_m"] for row in exact) > 0.05  # another formula: it is no error
    assert "document, encoder counts" in capsys.readouterr().out


@needs_data
def test_one_lost_encoder_count_of_the_real_robot_s_exceeds_the_limits(tmp_path):
    lost = drive(tmp_path, lambda row: [row[0], row[1] - (COUNT if row[0] > 100 else 0), row[2]])
    summary = integration_errors(lost)["summary"]
    assert not summary["kept"]
    assert summary["distance_max_m"] > MAX_DISTANCE
    assert summary["turn_max_deg"] > MAX_TURN


@needs_data
def test_a_drive_that_is_cut_short_is_refused(tmp_path):
    with gzip.open(drive(tmp_path) / "wheel_positions.csv.gz", "wt") as file:
        file.write("t,left,right\n0.1,0,0\n")
    with pytest.raises(UserError, match="1 rows"):
        integration_errors(tmp_path)


def test_without_data_the_command_says_what_it_needs(monkeypatch):
    monkeypatch.delenv("ZENAV_DATA", raising=False)
    with pytest.raises(UserError, match="no folder"):
        odometry(None, None)
