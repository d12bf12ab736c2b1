# SPDX-License-Identifier: Apache-2.0
"""Tests that must not run at the same time, or that share what is dear to make, go to one worker."""

from pathlib import Path

from tests.workers import STACK, Groups, group_of


def test_processes_and_sockets_run_one_after_the_other():
    files = [path.as_posix() for path in Path(__file__).parents[1].joinpath("stack").glob("test_*.py")]
    files += [path.as_posix() for path in Path(__file__).parents[1].joinpath("page").glob("test_page*.py")]
    names = [f"tests/{path.partition('/tests/')[2]}::test_a[b::c]" for path in files]
    assert len(names) > 5
    assert {group_of(name) for name in names} == {STACK}


def test_what_a_module_makes_once_stays_on_one_worker_and_others_go_anywhere():
    shared, single = "tests/unit/zenav/replay/test_reprocess.py", "tests/unit/test_workers.py"
    assert group_of(f"{shared}::test_a") == group_of(f"{shared}::test_b[x]") == shared
    assert group_of(f"{single}::test_a") != group_of(f"{single}::test_b")


def test_the_scheduler_asks_for_the_group():
    assert Groups._split_scope(None, f"{STACK}test_live.py::test_a") == STACK  # type: ignore[arg-type]  # needs no state
