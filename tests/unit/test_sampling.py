# SPDX-License-Identifier: Apache-2.0
"""When time is up, the last cases of a test are left out and all else runs; each comes first on one of three days."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sampling import DAYS, FEW, last_cases

ROOT = Path(__file__).parents[2]
HOOKS = """
from tests.conftest import (  # noqa: F401
    pytest_collection_modifyitems, pytest_configure, pytest_runtest_setup, pytest_terminal_summary
)
"""
TESTS = """
import pytest

@pytest.mark.parametrize("k", range(9))
def test_of_nine(k): ...

@pytest.mark.parametrize("k", range(3))
def test_of_three(k): ...

def test_alone(): ...
"""


@given(st.dictionaries(st.text("abc", min_size=1), st.integers(1, 9), max_size=5), st.integers(0, 40_000))
def test_each_case_comes_first_on_one_of_few_days_and_those_of_small_tests_on_each(tests, day):
    cases = {name: [f"{name}[{i}]" for i in range(n)] for name, n in tests.items()}
    names = [case for of_one in cases.values() for case in of_one]
    first = [set(names) - last_cases(names, day + i) for i in range(DAYS)]
    for of_one in cases.values():
        if len(of_one) < FEW:
            assert all(set(of_one) <= of_day for of_day in first)
        else:
            assert sorted(case for of_day in first for case in of_day & set(of_one)) == sorted(of_one)
            assert all(of_day & set(of_one) for of_day in first)


@pytest.mark.parametrize("options", [(), ("-n", "2")], ids=["one process", "two workers"])
@pytest.mark.parametrize(
    ("until", "passed", "left_out"),
    [("0", 3 + 3 + 1, 6), ("9" * 11, 9 + 3 + 1, 0)],
    ids=["time is up", "there is time"],
)
def test_cases_are_left_out_once_time_is_up_and_only_the_last_ones_of_large_tests(
    tmp_path, options, until, passed, left_out
):
    (tmp_path / "conftest.py").write_text(HOOKS)
    (tmp_path / "test_made_up.py").write_text(TESTS)
    kept = {k: v for k, v in os.environ.items() if not k.startswith("ZENAV_")}  # noqa: TID251
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--rootdir", tmp_path, *options, "test_made_up.py"],
        env={**kept, "PYTHONPATH": str(ROOT), "ZENAV_TESTS_UNTIL": until},
        cwd=tmp_path, capture_output=True, text=True, timeout=100, check=True,
    ).stdout  # fmt: skip
    assert f"{passed} passed" in done
    said = f"{left_out} tests skipped: run make test, which has the time for all cases"
    assert (said in done.splitlines()) == bool(left_out)
