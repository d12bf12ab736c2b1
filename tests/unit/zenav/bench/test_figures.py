# SPDX-License-Identifier: Apache-2.0
"""Published figures: an interrupted run goes on, a row says what it is from, the documents say what was measured."""

import json
import shlex
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import typer

from shared.config import UserError
from zenav.bench import footprint, serial
from zenav.bench.figure_cells import README
from zenav.bench.figure_pages import (
    MISSING,
    PAGES,
    PEERS,
    PLACES,
    TABLES,
    page_with_tables,
    tables_in,
    when_measured,
    write_pages,
)
from zenav.bench.figure_rows import ROWS, FigureRow
from zenav.bench.figures import Bench, measure_rows, selected_rows
from zenav.bench.localise import LocalizationTrial
from zenav.bench.published import ROOT, CheckoutState, PublishedFigure, checkout_state, load_published, save_published
from zenav.cli.commands import all_commands
from zenav.metrics.latency import LatencyChain, latency_figures
from zenav.scenario.mission import Mission

STATE = CheckoutState("abc1234", "c0de", False)


def summed(reports):
    return {README: [[str(sum(report["value"] for report in reports))]]}


THREE = FigureRow("three", "three parts", "zenav bench sim", summed, ("--a 1", "--a 2", "--a 3"))
ONE = FigureRow("one", "one part", "zenav bench serial", summed, jobs=True)
LOGS = FigureRow("logs", "on data", "zenav bench slam DIR", summed, data="slam")


class Commands:
    """Stands for the processes: notes what it was asked for, writes a report, or does what `happens` at that run."""

    def __init__(self, happens=None):
        self.asked, self.happens = [], happens or {}

    def __call__(self, arguments, folder):
        self.asked.append(arguments)
        what = self.happens.get(len(self.asked))
        if isinstance(what, BaseException):
            raise what
        if what == "no report":
            return 2
        out = Path(arguments[arguments.index("--out") + 1])
        out.write_text('{"val' if what == "half a report" else json.dumps({"value": 10 ** len(self.asked)}))
        return 1 if what == "target missed" else 0


def bench(folder, execute, state=STATE, **other):
    given = {"data": None, "jobs": 1, "file": folder / "figures.json", "pages": lambda published: None}
    given |= {"look": lambda: state} | other
    return Bench(folder=folder / "runs", state=state, execute=execute, **given)


def test_the_parts_of_a_row_make_one_entry(tmp_path):
    commands = Commands()
    assert measure_rows(bench(tmp_path, commands), [THREE])
    entry = load_published(tmp_path / "figures.json")["three"]
    assert entry.cells == {README: [["1110"]]}
    assert (entry.commit, entry.command, entry.dirty) == ("abc1234", "zenav bench sim", False)
    assert len(entry.load) == 2
    assert "core" in entry.machine
    assert entry.began <= entry.ended
    assert [asked[:4] for asked in commands.asked] == [["bench", "sim", "--a", str(i)] for i in (1, 2, 3)]


def test_what_was_interrupted_goes_on_after_the_last_finished_part(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        measure_rows(bench(tmp_path, Commands({3: KeyboardInterrupt()})), [THREE, ONE])
    assert load_published(tmp_path / "figures.json") == {}
    commands = Commands()
    assert measure_rows(bench(tmp_path, commands), [THREE, ONE])
    assert [asked[:-2] for asked in commands.asked] == [
        ["bench", "sim", "--a", "3"], ["bench", "serial", "--jobs", "1"],
    ]  # fmt: skip
    assert load_published(tmp_path / "figures.json")["three"].cells == {
        README: [["120"]]
    }  # 10 + 100 of before, 10 of now


def test_a_finished_row_is_in_the_file_before_the_next_one_runs(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        measure_rows(bench(tmp_path, Commands({2: KeyboardInterrupt()})), [ONE, THREE])
    assert set(load_published(tmp_path / "figures.json")) == {"one"}


def test_a_row_of_the_same_code_is_not_run_again_unless_it_is_asked_for(tmp_path):
    measure_rows(bench(tmp_path, Commands()), [THREE])
    commands = Commands()
    assert measure_rows(bench(tmp_path, commands, replace(STATE, commit="def5678")), [THREE])  # a commit of words
    assert commands.asked == []
    assert measure_rows(bench(tmp_path, commands), [THREE], again=True)
    assert len(commands.asked) == 3


@pytest.mark.parametrize("finished", [True, False])
def test_other_code_measures_everything_and_takes_no_old_part(tmp_path, finished):
    first = Commands({} if finished else {3: KeyboardInterrupt()})
    try:
        measure_rows(bench(tmp_path, first), [THREE])
    except KeyboardInterrupt:
        assert not finished
    commands = Commands()
    assert measure_rows(bench(tmp_path, commands, CheckoutState("def5678", "0ther", False)), [THREE])
    assert len(commands.asked) == 3
    assert load_published(tmp_path / "figures.json")["three"].commit == "def5678"


def test_with_changes_that_are_not_committed_nothing_is_taken_over_and_the_row_says_so(tmp_path):
    dirty = replace(STATE, dirty=True)
    for _ in range(2):
        commands = Commands()
        measure_rows(bench(tmp_path, commands, dirty), [ONE])
        assert len(commands.asked) == 1
    entry = load_published(tmp_path / "figures.json")["one"]
    assert "`abc1234` with uncommitted changes" in when_measured(entry)
    commands = Commands()
    measure_rows(bench(tmp_path, commands), [ONE])
    assert len(commands.asked) == 1


def test_a_row_whose_command_changed_is_run_again(tmp_path):
    measure_rows(bench(tmp_path, Commands()), [THREE])
    commands = Commands()
    measure_rows(bench(tmp_path, commands), [replace(THREE, command="zenav bench sim --faster")])
    assert len(commands.asked) == 3


def test_other_jobs_are_the_same_figures(tmp_path):
    measure_rows(bench(tmp_path, Commands()), [ONE])
    (tmp_path / "figures.json").unlink()
    commands = Commands()
    measure_rows(bench(tmp_path, commands, jobs=2), [ONE])
    assert commands.asked == []


@pytest.mark.parametrize("trouble", ["no report", "half a report"])
def test_a_row_that_fails_is_told_and_the_next_one_is_run(tmp_path, capsys, trouble):
    assert not measure_rows(bench(tmp_path, Commands({2: trouble})), [THREE, ONE])
    assert set(load_published(tmp_path / "figures.json")) == {"one"}
    assert "three: failed: bench sim --a 2" in capsys.readouterr().err


def test_a_row_without_its_data_is_told_and_the_next_one_is_run(tmp_path, capsys):
    commands = Commands()
    assert not measure_rows(bench(tmp_path, commands), [LOGS, ONE])
    assert "logs: needs data: set ZENAV_DATA" in capsys.readouterr().err
    assert set(load_published(tmp_path / "figures.json")) == {"one"}
    assert not measure_rows(bench(tmp_path, commands, data=tmp_path), [LOGS])
    assert f"there is no {tmp_path / 'slam'}" in capsys.readouterr().err


def test_the_data_s_folder_stands_where_the_command_shows_dir(tmp_path):
    (tmp_path / "slam").mkdir()
    commands = Commands()
    assert measure_rows(bench(tmp_path, commands, data=tmp_path), [LOGS])
    assert commands.asked[0][:3] == ["bench", "slam", str(tmp_path / "slam")]
    assert load_published(tmp_path / "figures.json")["logs"].command == "zenav bench slam DIR"


def test_a_missed_target_is_published_as_one(tmp_path):
    assert measure_rows(bench(tmp_path, Commands({1: "target missed"})), [ONE])
    entry = load_published(tmp_path / "figures.json")["one"]
    assert not entry.kept
    assert when_measured(entry).endswith("missed its target")


@pytest.mark.parametrize("now", [CheckoutState("abc1234", "0ther", False), CheckoutState("abc1234", "c0de", True)])
def test_code_that_changes_while_a_part_runs_ends_it_and_the_part_is_not_kept(tmp_path, now):
    states = iter([STATE, now])
    with pytest.raises(UserError, match="changed while three ran"):
        measure_rows(bench(tmp_path, Commands(), look=lambda: next(states)), [THREE])
    assert load_published(tmp_path / "figures.json") == {}
    commands = Commands()
    measure_rows(bench(tmp_path, commands), [THREE])
    assert [asked[3] for asked in commands.asked] == ["2", "3"]


def test_a_commit_of_words_meanwhile_is_no_change_of_the_code(tmp_path):
    assert measure_rows(bench(tmp_path, Commands(), look=lambda: replace(STATE, commit="def5678")), [THREE])


def test_what_runs_leave_for_each_other_is_apart_for_code_with_changes(tmp_path):
    clean, dirty = (bench(tmp_path, Commands(), replace(STATE, dirty=dirty)) for dirty in (False, True))
    row = next(row for row in ROWS if row.name == "localise")
    assert clean.arguments(row, row.parts[0]) != dirty.arguments(row, row.parts[0])


def test_a_damaged_part_is_run_again(tmp_path):
    there = bench(tmp_path, Commands())
    measure_rows(there, [THREE])
    (tmp_path / "figures.json").unlink()
    (there.work() / "three" / "part-01.json").write_text('{"arguments": []')
    commands = Commands()
    measure_rows(bench(tmp_path, commands), [THREE])
    assert [asked[3] for asked in commands.asked] == ["2"]


def test_the_pages_are_written_after_each_row(tmp_path):
    written = []
    measure_rows(bench(tmp_path, Commands(), pages=lambda published: written.append(set(published))), [ONE, THREE])
    assert written == [{"one"}, {"one", "three"}]


def test_rows_are_chosen_by_name_and_a_wrong_one_is_refused():
    assert [row.name for row in selected_rows("sim,office")] == ["office", "sim"]
    assert selected_rows("") == list(ROWS)
    with pytest.raises(UserError, match="'ofice'"):
        selected_rows("ofice")


# --- the checkout


@pytest.fixture
def checkout(tmp_path):
    def git(*arguments):
        identity = "-c", "user.name=a", "-c", "user.email=a@b"
        subprocess.run(("git", *identity, *arguments), cwd=tmp_path, check=True, capture_output=True)

    for folder in ("services", "shared", "zenav/bench", "shared/robots", "docs"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "a").write_text("1")
    (tmp_path / "requirements.txt").write_text("1")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "first")
    return tmp_path, git


@pytest.mark.parametrize(
    ("path", "counts"),
    [("services/a", True), ("requirements.txt", True), ("shared/robots/new", True), ("docs/a", False),
     ("README.md", False),     ("zenav/bench/figure_rows.py", False), ("zenav/bench/a", True)],
)  # fmt: skip
def test_a_commit_of_code_is_another_code_and_one_of_words_is_not(checkout, path, counts):
    root, git = checkout
    before = checkout_state(root)
    (root / path).write_text("2")
    git("add", "-A")
    assert checkout_state(root).dirty is counts
    git("commit", "-qm", "second")
    now = checkout_state(root)
    assert not now.dirty
    assert now.commit != before.commit
    assert (now.code != before.code) is counts


def test_outside_of_a_checkout_there_is_nothing_to_measure(tmp_path):
    with pytest.raises(UserError, match="no commit"):
        checkout_state(tmp_path)


# --- the documents


@pytest.mark.parametrize("page", PAGES)
def test_the_documents_say_what_the_file_of_figures_says(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert page_with_tables(text, load_published()) == text, "make docs, or make figures; no row is edited by hand"


def test_every_table_has_one_place_in_the_documents():
    named = [name for page in PAGES for name in tables_in((ROOT / page).read_text(encoding="utf-8"))]
    assert sorted(named) == sorted(TABLES)


def test_an_edited_row_is_not_what_the_file_says(tmp_path):
    entry = PublishedFigure(
        "zenav bench sim", {README: [["85 times"]]}, "abc1234", "2026-11-20 10:00:00", load=(0.1, 0.2)
    )
    text = page_with_tables(f"before\n\n<!-- figures: {README} -->\n<!-- end -->\n\nafter\n", {"sim": entry})
    assert "| 85 times | `zenav bench sim` | `abc1234`, 2026-11-20, load 0.1 to 0.2 |" in text
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert page_with_tables(text.replace("85", "95"), {"sim": entry}) == text


def test_a_row_that_was_never_measured_says_so():
    text = page_with_tables(f"<!-- figures: {README} -->\n<!-- end -->\n", {})
    assert text.count(f"| {MISSING} |") == sum(bool(row.what) for row in ROWS)


def test_a_marker_that_names_no_figures_is_refused():
    with pytest.raises(UserError, match="'speed'"):
        page_with_tables("<!-- figures: speed -->\n<!-- end -->\n", {})


def test_writing_leaves_documents_that_say_it_already_alone(tmp_path):
    (tmp_path / "docs").mkdir()
    for page in PAGES:
        (tmp_path / page).write_text((ROOT / page).read_text(encoding="utf-8"), encoding="utf-8")
    before = {page: (tmp_path / page).stat().st_mtime_ns for page in PAGES}
    write_pages(load_published(), tmp_path)
    assert {page: (tmp_path / page).stat().st_mtime_ns for page in PAGES} == before


def test_every_entry_is_a_row_s_and_fits_its_table():
    rows = {row.name: row for row in ROWS}
    for name, entry in load_published().items():
        assert name in rows
        assert entry.commit
        for place, lines in entry.cells.items():
            width = {len(line) for line in lines}
            if place == README:
                assert width == {1}
            elif place in PLACES:
                assert name in PLACES[place].rows
                assert width == {len(PLACES[place].head)}
            else:
                assert place.startswith("beside-")
                assert {line[0] for line in lines} <= set(PEERS)


def _git(*arguments: str) -> str:
    return subprocess.run(("git", *arguments), cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def test_the_commit_of_every_row_is_in_the_history():
    if not (ROOT / ".git").exists() or _git("rev-parse", "--is-shallow-repository") == "true":
        pytest.skip("needs the whole history of commits")
    known = {commit[:7] for commit in _git("rev-list", "HEAD").split()}
    commits = {name: entry.commit for name, entry in load_published().items()}
    if known.isdisjoint(commits.values()):
        pytest.skip("needs the whole history of commits: this one begins after all rows")
    strangers = {name: commit for name, commit in commits.items() if commit not in known}
    assert not strangers, "measure these rows on a commit of this history: zenav bench figures --only ROW"


def test_the_file_comes_back_as_it_was_written(tmp_path):
    entries = {
        "sim": PublishedFigure(
            "c", {"a": [["1", "2"]]}, "abc", "2026-11-20", "c0de", True, "b", 1.5, "m", (0.1, 2.0), False
        )
    }
    save_published(entries, tmp_path / "f.json")
    assert load_published(tmp_path / "f.json") == entries
    (tmp_path / "f.json").write_text('{"sim": {"command": 3}}')
    with pytest.raises(UserError, match="damaged"):
        load_published(tmp_path / "f.json")


# --- the table of rows


RUN = {"world": 2, "seed": 0, "status": "success", "time": 4.6, "score": 0.5, "clearance": 0.1772, "recoveries": 0,
       "length": 9.1, "said": "", "stood": False}  # fmt: skip
ERRORS = {"n": 1625, "trans_mean_m": 0.0433, "trans_std_m": 0.03, "trans_median_m": 0.03, "trans_max_m": 0.2366,
          "rot_mean_deg": 0.5}  # fmt: skip
LOG = {"errors": {"loops": ERRORS, "neighbours": ERRORS}, "cpu_s": 7.4, "cpu_s_of_jobs": 5.3, "scan_ms_median": 2.2,
       "scan_ms_p99": 4.3, "memory_mb": 345, "keyframes": 895, "loops": 542}  # fmt: skip


def nothing_seen():
    """A run of the room in which nothing was heard."""
    from zenav.metrics.evaluation import RunTrack
    from zenav.scenario.scenario import ScenarioResult, load_scenario

    chosen = load_scenario("x80sv", "room", 0, [])
    return ScenarioResult(chosen, RunTrack(), Mission(chosen.goals, lambda *_: None), 1.0)


def of_soak():
    from zenav.bench.service_faults import FaultReport
    from zenav.bench.soak import SoakPlan, report_of
    from zenav.bench.soak_runs import SoakRun
    from zenav.bench.soak_samples import ServiceSample

    samples = {"guard": [ServiceSample(float(at), 1, 40.0) for at in range(60)]}
    fault = FaultReport("guard", "kill", 20.0, 0.0, was_driving=True, zero_s=0.1)
    run = SoakRun(nothing_seen(), samples, [fault], cpu=[(0.0, 0.0), (60.0, 6.0)])
    return report_of(run, Path("/none/run.mcap"), SoakPlan(1.0, 20.0, 0, lockstep=True), None)


def of_merge():
    from zenav.bench.merge import MergeTrial

    joined = MergeTrial("building:3", "building:3", 0.3, 0.5, "", "4 of 5", 9, 0.012, 0.05, 0.99, 0.98, 0.97, 11.0)
    other = MergeTrial("building:3", "building:4", 0.3, refused="no common place")
    return {"trials": [asdict(joined), asdict(other)]}


def of_fault():
    from zenav.bench.fault_table import FAULT_ROWS as FAULTS
    from zenav.bench.fault_trial import FaultResult
    from zenav.bench.faults import fault_summary, table_row

    result = FaultResult(FAULTS[0].name, "navigation", 0.5, 0)
    return {"summary": fault_summary([result]), "rows": [table_row(FAULTS[0], [result])]}


def of_plan():
    from zenav.bench.plan.measure import PlannerRow as Planned

    def planned(**figures):
        row = Planned([0.1, 0.2], 2, 2, 0)
        for name, value in figures.items():
            row.note(name, value)
        return row.summary()

    def size(length):
        return {"ours, with costs": planned(), "ours, free and blocked": planned(length=length), "NavFn A*": planned()}

    depot = {"ours": planned(path_m=13.5, clearance_mean_m=0.9, equal=1.01), "NavFn Dijkstra": planned()}
    return {"summary": {"256": size(1.005), "512": size(1.009), "1024": size(1.0), "4096": size(1.0), "depot": depot}}


def of_stack():
    parts = dict.fromkeys(("to_control", "wait", "control", "guard", "member"), np.full(9, 0.003))
    chain = LatencyChain(**parts, handlers=np.full(9, 0.006), sent=np.zeros(9, np.int64), lost={}, n_scans=9)
    told = latency_figures(chain)
    return told | {"summary": told["summary"] | {"first_motion_s": 8.5}}


REPORTS = {
    "office": lambda: {"runs": [nothing_seen().report()]},
    "demo": lambda: nothing_seen().report(),
    "buildings": lambda: {"runs": [{"building": 3, "trouble": "no way to a room"}]},
    "localise": lambda: {"trials": [asdict(LocalizationTrial(3, 0, 1.9, 0.01, 0.0, 0.5, 2.7, True)),
                                     asdict(LocalizationTrial(3, 1))]},
    "barn": lambda: {"runs": [RUN, RUN | {"status": "collision", "score": 0.0, "stood": True}]},
    "slam": lambda: {"summary": {"intel-sparse": LOG}},
    "odometry": lambda: {"rows": {f"{name}, encoder counts": {"distance_max_m": 1e-4, "distance_end_m": 1e-4,
                         "turn_max_deg": 0.004} for name in ("document", "exact")}},
    "plan": of_plan,
    "faults": of_fault,
    "soak": of_soak,
    "merge": of_merge,
    "gyro": lambda: {"summary": {"wheels_deg": 30.1, "gyro_deg": 5.2},
                     "rows": {"fhw": {"driven_m": 398.2, "wheels_deg": 71.2, "gyro_deg": 4.1, "n_slips": 0}}},
    "sim": lambda: {"summary": {"ratio": 85.4}},
    "stack": of_stack,
    "footprint": lambda: footprint.figures({"guard": footprint.Usage(30, 20, 90)}, {"guard": [0.3]}, 3.9, {}),
    "serial": lambda: serial.serial_figures({key: [0.001] for key in ("command", "wheels", "taken")},
                                            {"a": {"1": 2.0}}),
}  # fmt: skip


def report_of(name):
    kind = name.partition("-")[0]
    return REPORTS["barn" if kind == "crowd" else kind]()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_what_a_benchmark_reports_becomes_cells_that_fit_their_tables(row):
    cells = row.cells([report_of(row.name)] * len(row.parts))
    (((figure,),)) = cells[README]
    assert figure
    for name, lines in cells.items():
        assert lines
        assert all(isinstance(cell, str) for line in lines for cell in line)
        if name in PLACES:
            assert row.name in PLACES[name].rows
            assert {len(line) for line in lines} == {len(PLACES[name].head)}
        else:
            assert name == README or name.startswith("beside-")
    text = "".join(f"<!-- figures: {name} -->\n<!-- end -->\n" for name in TABLES)
    entry = PublishedFigure(row.command, cells, "abc1234", "2026-11-20", load=(0.1, 0.2))
    assert MISSING in page_with_tables(text, {row.name: entry})


def test_a_collision_is_in_the_figure():
    row = next(row for row in ROWS if row.name == "barn")
    cells = row.cells([REPORTS["barn"]()] * 3)
    assert cells[README] == [["success 3 of 6; collisions 3; time-outs 0; score 0.2500"]]
    assert cells["barn"][0][1:6] == ["6", "0.500", "3", "3", "0"]


def test_a_long_run_says_which_limits_it_missed():
    row = next(row for row in ROWS if row.name == "soak-faults")
    report = of_soak()
    (line,) = row.cells([report])["soak"]
    assert "kill guard after 20 s: the robot stood for inf s" in line[-1]
    assert row.cells([report | {"broken": []}])["soak"][0][-1] == "none"


def test_the_names_of_rows_are_different():
    assert len({row.name for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_every_part_of_a_row_is_a_command_that_writes_json(row):
    for part in row.parts:
        there = Bench(Path("/runs"), Path("/data"), STATE, 2, lambda arguments, folder: 0)
        arguments = [*there.arguments(row, part), "--out", "out.json"]
        parsed = typer.main.get_command(all_commands())
        context = None
        while hasattr(parsed, "resolve_command"):
            context = parsed.make_context(parsed.name, list(arguments), parent=context)
            _, parsed, arguments = parsed.resolve_command(context, list(arguments))
        given = parsed.make_context(parsed.name, list(arguments), parent=context).params
        assert given["out"] == Path("out.json")
        assert not any("DIR" in str(value) for value in given.values())
        if row.jobs:
            assert given["jobs"] == 2


def parsed_numbers(row, option):
    from zenav.bench.seeds import seeds_from

    words = [shlex.split(part) for part in row.parts]
    return sorted(number for part in words for number in seeds_from(part[part.index(option) + 1]))


@pytest.mark.parametrize(
    ("name", "option", "numbers"),
    [("office", "--seeds", range(10)), ("office-live", "--seeds", range(10, 15)),
     ("buildings", "--buildings", range(20)), ("localise", "--buildings", range(20)), ("barn", "--worlds", range(300)),
     ("barn-noise", "--worlds", range(300)), ("crowd", "--worlds", range(100)),
     ("crowd-unseen", "--worlds", range(1000, 1100)), ("localise-ros-5cm", "--buildings", range(20)),
     ("localise-ros-10cm", "--buildings", range(20))],
)  # fmt: skip
def test_the_parts_of_a_row_are_the_whole_command(name, option, numbers):
    row = next(row for row in ROWS if row.name == name)
    assert parsed_numbers(row, option) == list(numbers)
    asked = published_option(row.command, option)
    assert asked in (None, list(numbers))


def published_option(command, option):
    from zenav.bench.seeds import seeds_from

    words = shlex.split(command)
    return seeds_from(words[words.index(option) + 1]) if option in words else None


def test_crowds_that_are_called_unseen_are_none_of_those_used():
    from zenav.bench.barn import CROWDS, CROWDS_FITTED, CROWDS_UNSEEN
    from zenav.bench.seeds import seeds_from

    used = {*seeds_from(CROWDS), *seeds_from(CROWDS_FITTED)}
    assert not used & set(seeds_from(CROWDS_UNSEEN))
