# SPDX-License-Identifier: Apache-2.0
"""`zenav recording find`: the catalogue holds what its recordings say, and expressions mean what Python means."""

import json
import os
import shutil
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import UserError
from tests.replay.record import path_of
from zenav.__main__ import _status
from zenav.batch import catalogue_update
from zenav.batch.catalogue import COLUMNS, FOLDER, table_of
from zenav.batch.catalogue_update import update
from zenav.batch.child_process import Outcome
from zenav.batch.finding import query
from zenav.batch.query import condition
from zenav.batch.storage import sources

EMPTY = dict.fromkeys(COLUMNS)


def row(name, **columns):
    return {**EMPTY, "recording": name, "state": "done", "started": 1_790_000_000_000_000, **columns}


def found(expression, rows):
    return [hit["recording"] for hit in query(table_of(rows), condition(expression))]


ROWS = [
    row("a", robot="red", duration=90.0, contact=True, stops=["obstacle"], faults=[], goals=2),
    row("b", robot="red", duration=30.0, contact=False, stops=[], faults=["wheel_stuck"], goals=0),
    row("c", robot="blue", duration=61.0, contact=True, stops=["obstacle", "bumper"], faults=[], goals=1),
    row("d", state="refused", error="no recording", started=None),
]


@pytest.mark.parametrize(
    ("expression", "names"),
    [
        ("", "abcd"),
        ("robot=red and contact and duration>60", "a"),
        ("contact", "ac"),
        ("not contact", "bd"),
        ("goals", "ac"),
        ("not goals", "bd"),
        ("not goals and robot=red", "b"),
        ("stops=bumper or faults", "bc"),
        ("stops!=bumper", "ab"),
        ("not (robot=red or robot='blue')", ""),
        ("goals>=1 and (robot=blue or duration<40)", "c"),
        ("robot~RE", "ab"),
        ("state=refused", "d"),
        ("duration>6e1", "ac"),
        ("goals>0.5", "ac"),
        ("goals>=1.5", "a"),
        ("started", "abc"),
        ("not started", "d"),
        ("started>2026-01-01 and started<'2027-01-01 10:00'", "abc"),
        ('robot="x\'; DROP TABLE catalogue; --"', ""),
    ],
)
def test_an_expression_finds_what_it_says(expression, names):
    assert sorted(found(expression, ROWS)) == list(names)


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        ("robott=red", "'robott' is no column"),
        ("duration>long", "'long' is no number"),
        ("duration>", "a value is missing"),
        ("(contact", "a closing bracket is missing"),
        ("contact robot=red", "'robot' is too much"),
        ("stops>obstacle", "stops is a list"),
        ("started>yesterday", "'yesterday' is no time"),
        ("started>2026-02-30", "'2026-02-30' is no time"),
        ("started>2026-02-28T25:00", "is no time"),
        ("contact and !", "is no condition"),
    ],
)
def test_a_wrong_expression_is_one_line_that_says_what(expression, words):
    with pytest.raises(UserError, match=words.replace("(", r"\(")):
        condition(expression)


LEAF = st.sampled_from(
    [("contact", lambda r: r["contact"]), ("robot=red", lambda r: r["robot"] == "red"),
     ("duration>60", lambda r: r["duration"] > 60), ("goals<2", lambda r: r["goals"] < 2),
     ("stops=bumper", lambda r: "bumper" in r["stops"]), ("goals", lambda r: r["goals"] != 0)]
)  # fmt: skip
TREES = st.recursive(
    LEAF,
    lambda inner: st.one_of(
        inner.map(lambda a: (f"not ({a[0]})", lambda r: not a[1](r))),
        LEAF.map(lambda a: (f"not {a[0]}", lambda r: not a[1](r))),
        st.tuples(inner, inner).map(
            lambda ab: (f"({ab[0][0]}) and ({ab[1][0]})", lambda r: ab[0][1](r) and ab[1][1](r))
        ),
        st.tuples(inner, inner).map(lambda ab: (f"({ab[0][0]}) or ({ab[1][0]})", lambda r: ab[0][1](r) or ab[1][1](r))),
    ),
    max_leaves=5,
)


@settings(max_examples=40, deadline=None)
@given(TREES)
def test_expressions_mean_what_python_means(tree):
    expression, holds = tree
    assert sorted(found(expression, ROWS[:3])) == [r["recording"] for r in ROWS[:3] if holds(r)]


def test_the_catalogue_says_what_was_recorded_and_only_what_changed_is_read_again(tmp_path, capsys):
    for name in ("driving", "killed_service"):
        shutil.copy(path_of(name), tmp_path / f"{name}.mcap")
    (tmp_path / "broken.mcap").write_bytes(b"no recording")
    assert _status(["recording", "find", "driven>0.5 and not contact", str(tmp_path), "--json"]) == 0
    told = capsys.readouterr()
    rows = {os.path.basename(r["recording"]): r for r in map(json.loads, told.out.splitlines())}
    assert set(rows) == {"driving.mcap", "killed_service.mcap"}
    driving = rows["driving.mcap"]
    assert driving["robot"] == "x80"
    assert 5 < driving["duration"] < 60
    assert {"guard", "mapper", "navigator", "local_ctrl"} <= set(driving["services"])
    assert told.err.count(" of 3: ") == 3
    assert _status(["recording", "find", "state!=done", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert "broken.mcap" in told.out
    assert told.err == "", "nothing was read again"

    later = time.time_ns() + 10**9
    os.utime(tmp_path / "driving.mcap", ns=(later, later))
    (tmp_path / "broken.mcap").unlink()
    assert len(update(str(tmp_path), 1)) == 2
    assert capsys.readouterr().err.count("driving.mcap") == 1
    assert _status(["recording", "find", "robot=green", str(tmp_path), "--as-it-is"]) == 1
    shutil.rmtree(tmp_path / FOLDER)
    assert _status(["recording", "find", "robot=green", str(tmp_path), "--as-it-is"]) == 2


def test_a_recording_whose_reading_failed_is_read_again(tmp_path, monkeypatch):
    shutil.copy(path_of("driving"), tmp_path / "a.mcap")
    with monkeypatch.context() as patch:
        failed = [Outcome("raised", detail="Could not connect"), Outcome("died", detail="killed by SIGKILL")]
        for outcome in failed:
            patch.setattr(
                catalogue_update, "results", lambda work, new, *a, of=outcome, **b: ((one, of) for one in new)
            )
            assert update(str(tmp_path), 1)["error"].to_pylist() == [outcome.detail]
    assert update(str(tmp_path), 1)["state"].to_pylist() == ["done"]


@pytest.mark.parametrize("content", [b"", b"[]", b"\xff\xfe", b"PAR1 and then noise"])
@pytest.mark.parametrize("ending", ["json", "parquet"])
def test_a_damaged_file_of_the_catalogue_is_named_and_refresh_replaces_it(tmp_path, capsys, content, ending):
    shutil.copy(path_of("driving"), tmp_path / "a.mcap")
    assert update(str(tmp_path), 1).num_rows == 1
    damaged = tmp_path / FOLDER / f"damaged.{ending}"
    damaged.write_bytes(content)
    assert _status(["recording", "find", "", str(tmp_path)]) == 2
    assert f"{FOLDER}/{damaged.name} is damaged" in capsys.readouterr().err
    assert _status(["recording", "find", "", str(tmp_path), "--refresh"]) == 0
    assert not damaged.exists()
    assert _status(["recording", "find", "", str(tmp_path)]) == 0


def test_signs_of_globs_in_the_names_of_files_and_folders_are_letters(tmp_path, capsys):
    folder = tmp_path / "run[1]"
    folder.mkdir()
    name = folder / "a[1]{2}[bold].mcap"
    shutil.copy(path_of("driving"), name)
    for _ in range(2):
        assert _status(["recording", "find", "", str(folder)]) == 0
        assert name.name in capsys.readouterr().out
    assert [source.url for source in sources([str(name)])] == [f"file://{name}"]
    assert len(sources([f"{tmp_path}/run*/*.mcap"])) == 1
