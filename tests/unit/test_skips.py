# SPDX-License-Identifier: Apache-2.0
"""A run says what it skipped and what provides it, fails where CI has the data, and draws new examples on request."""

import ast
import os
import shutil
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from tests.skips import NEEDS, lines, need_of

ROOT = Path(__file__).parents[2]
TESTS = """
import pytest
from hypothesis import given, strategies as st

@pytest.mark.skip(reason="ZENAV_DATA is not set: no logs")
@pytest.mark.parametrize("k", range(3))
def test_a(k): ...

def test_b():
    pytest.skip("the recording was made with another processor, C library or numpy")

@given(st.integers(0, 10**9))
def test_c(n):
    with open({drawn!r}, "a") as file:
        file.write(f"{{n}} ")
"""
HOOKS = "from tests.conftest import pytest_configure, pytest_sessionfinish, pytest_terminal_summary  # noqa: F401"
ON_DATA = "3 tests skipped: set ZENAV_DATA to the folder with slam, barn, planning, bags and x80sv"


def test_one_line_a_need_with_the_number_of_tests_the_most_first():
    found = lines(["evo is not installed", "ZENAV_DATA is not set", "slam_eval.py is not here", "the moon is full"])
    assert found == [
        "2 tests skipped: set ZENAV_DATA to the folder with slam, barn, planning, bags and x80sv",
        "1 test skipped: pip install -r requirements-dev.txt",
        "1 test skipped: the moon is full",
    ]
    assert lines([]) == []


def test_every_skip_of_these_tests_has_a_line_that_says_what_provides_it():
    reasons = {reason for path in ROOT.joinpath("tests").rglob("*.py") for reason in _reasons(path)}
    assert len(reasons) > 10
    assert [reason for reason in reasons if need_of(reason) not in NEEDS] == []


def _reasons(path):
    """The literal reasons of skip and skipif in a file."""
    if path == Path(__file__):
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("skip", "skipif"):
            said = [*node.args[:1], *(word.value for word in node.keywords if word.arg == "reason")]
            yield from (word.value for word in said if isinstance(word, ast.Constant) and isinstance(word.value, str))


def run_of(folder, *options, **environment):
    """(exit status, output, examples drawn) of pytest on TESTS."""
    drawn = folder / "drawn"
    drawn.unlink(missing_ok=True)
    path = folder / "test_made_up.py"
    path.write_text(TESTS.format(drawn=str(drawn)))
    (folder / "conftest.py").write_text(HOOKS)
    kept = {k: v for k, v in os.environ.items() if not k.startswith("ZENAV_")}  # noqa: TID251
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--rootdir", folder, *options, path],
        env={**kept, "PYTHONPATH": str(ROOT), "CI": "true", **environment},
        cwd=folder, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr, drawn.read_text()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    required, seed = {"ZENAV_REQUIRE_DATA": "1"}, "ZENAV_HYPOTHESIS_SEED"
    return {
        "plain": run_of(folder),
        "required": run_of(folder, "-n", "2", **required, **{seed: "1"}),
        "none skipped": run_of(folder, "-k", "not test_a", **required, **{seed: "1"}),
        "other seed": run_of(folder, "-n", "1", "-k", "test_c", **{seed: "2"}),
    }


def test_a_run_ends_with_what_it_skipped(runs):
    for name in ("plain", "required"):
        said = runs[name][1].splitlines()
        assert ON_DATA in said
        assert "1 test skipped: run them where the recordings were made, or make record-references" in said


def test_skipped_tests_on_data_fail_a_run_only_where_data_is_required(runs):
    assert {name: status for name, (status, _, _) in runs.items()} == {
        "plain": 0, "required": 1, "none skipped": 0, "other seed": 0,
    }  # fmt: skip
    assert "failed: ZENAV_REQUIRE_DATA=1, and tests on data were skipped" in runs["required"][1].splitlines()


def test_a_seed_draws_its_own_examples_again_and_is_printed(runs):
    drawn = {name: examples for name, (_, _, examples) in runs.items()}
    assert drawn["required"] == drawn["none skipped"]
    assert len({drawn["plain"], drawn["required"], drawn["other seed"]}) == 3
    assert "hypothesis seed" not in runs["plain"][1]
    assert "hypothesis seed 2: run again with ZENAV_HYPOTHESIS_SEED=2" in runs["other seed"][1].splitlines()


def ci(checkout, **environment):
    """The environment that .ci/run passes to each call of make, by target."""
    (checkout / ".ci").mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / ".ci" / "run", checkout / ".ci" / "run")
    make = checkout / "bin" / "make"
    make.parent.mkdir(exist_ok=True)
    make.write_text('#!/bin/sh\necho "made $1 ${ZENAV_REQUIRE_DATA:-0} ${ZENAV_HYPOTHESIS_SEED:-0}"\n')
    make.chmod(0o755)
    kept = {k: v for k, v in os.environ.items() if not k.startswith("ZENAV_")}  # noqa: TID251
    output = subprocess.run(
        [checkout / ".ci" / "run"], env={**kept, "PATH": f"{make.parent}:{kept['PATH']}", **environment},
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    return output, {line.split()[1]: line.split()[2:] for line in output.splitlines() if line.startswith("made ")}


def test_ci_requires_the_data_that_lies_next_to_it(tmp_path):
    assert ci(tmp_path / "a" / "checkout")[1]["test"][0] == "0"
    (tmp_path / "b" / "shared" / "data").mkdir(parents=True)
    assert ci(tmp_path / "b" / "checkout")[1]["test"][0] == "1"


def test_ci_draws_by_the_date_or_by_the_seed_that_it_is_given_and_prints_it(tmp_path):
    output, made = ci(tmp_path / "checkout")
    seed = made["test"][1]
    assert datetime.strptime(seed, "%Y%m%d").year >= 2026, "a day"
    assert f"ZENAV_HYPOTHESIS_SEED={seed}" in output
    assert ci(tmp_path / "checkout", ZENAV_HYPOTHESIS_SEED="17")[1]["test"][1] == "17"
