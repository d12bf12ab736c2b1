# SPDX-License-Identifier: Apache-2.0
"""Names of files are shown as they are, whatever they mean to the library of the terminal."""

from collections.abc import Iterator
from contextlib import AbstractContextManager

import pytest

from zenav.console.progress import progress_bar
from zenav.console.table import show_table
from zenav.replay.player import progress_display
from zenav.stack import doctor

NAME = "run{1}[bold]:warning:[/].mcap"


def test_a_table_shows_names_as_they_are(capsys):
    show_table("", ("recording", "MB"), [(NAME, "1.0")])
    assert NAME in capsys.readouterr().out


def test_the_doctor_shows_paths_as_they_are(capsys, monkeypatch):
    def found(where: object, robot: str) -> Iterator[doctor.DoctorFinding]:
        yield doctor.DoctorFinding("disk", doctor.OK, NAME, NAME)

    monkeypatch.setattr(doctor, "findings", found)
    assert doctor.doctor("x80sv", "0") == 0
    assert capsys.readouterr().out.count(NAME) == 2


@pytest.mark.parametrize("bar", [progress_bar(NAME), progress_display(NAME, 1.0)], ids=["bar", "player"])
def test_a_progress_bar_shows_names_as_they_are(bar: AbstractContextManager[object], capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")
    with bar:
        pass
    assert NAME in capsys.readouterr().err
