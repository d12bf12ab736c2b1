# SPDX-License-Identifier: Apache-2.0
"""Repeatable arithmetic, before anything imports numpy; repeatable examples, however busy the machine is.

Environment: ZENAV_HYPOTHESIS_SEED=N draws other examples, by this seed; ZENAV_REQUIRE_DATA=1 fails a run whose tests on
ZENAV_DATA were skipped; ZENAV_TESTS_UNTIL=T (s since 1970) leaves out some cases of tests with several from then on.
"""

import shared.repeatable  # noqa: F401

# isort: split
import os
import time
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.sampling import last_cases
from tests.skips import NO_TIME, lacks_data, lines
from tests.workers import Groups

SEED = os.environ.get("ZENAV_HYPOTHESIS_SEED")  # noqa: TID251  # which examples to draw
REQUIRE_DATA = os.environ.get("ZENAV_REQUIRE_DATA") == "1"  # noqa: TID251  # CI has the data
UNTIL = os.environ.get("ZENAV_TESTS_UNTIL")  # noqa: TID251  # CI on a slow machine
LAST = pytest.StashKey[set[str]]()
DAY_S = 86_400

pytest.register_assert_rewrite("tests.stack.processes", "tests.replay.record", "tests.strategies", "tests.toys")

# derandomize is said: where CI is set, Hypothesis's own profile has it
settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=False)
settings.register_profile("steady", settings.get_profile("explore"), derandomize=True)
settings.load_profile("explore" if SEED else "steady")


@pytest.hookimpl(tryfirst=True)  # before Hypothesis reads its option
def pytest_configure(config: Any) -> None:
    """Draws examples by ZENAV_HYPOTHESIS_SEED, as --hypothesis-seed would."""
    if SEED and config.option.hypothesis_seed is None:
        config.option.hypothesis_seed = SEED


def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Puts the cases last that may be left out."""
    if UNTIL:
        config.stash[LAST] = last_cases((item.nodeid for item in items), int(UNTIL) // DAY_S)
        items.sort(key=lambda item: item.nodeid in config.stash[LAST])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: Any) -> None:
    """Leaves out the last cases once time is up."""
    if UNTIL and item.nodeid in item.config.stash[LAST] and time.time() > int(UNTIL):  # noqa: TID251  # CI's clock
        pytest.skip(NO_TIME)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: Any, log: Any) -> Groups:
    """How tests are shared out among workers."""
    return Groups(config, log)


def reasons_of(config: Any) -> list[str]:
    """Why tests were skipped, one a test; of all workers. Empty in a worker."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    reports = reporter.stats.get("skipped", []) if reporter else []
    return [report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr) for report in reports]


def pytest_sessionfinish(session: Any, exitstatus: int) -> None:
    """Fails the run where data is required and tests on it were skipped."""
    if REQUIRE_DATA and exitstatus == pytest.ExitCode.OK and lacks_data(reasons_of(session.config)):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any, config: Any) -> None:
    """What was skipped and what provides it, and how to draw the same examples again."""
    reasons = reasons_of(config)
    for line in lines(reasons):
        terminalreporter.write_line(line)
    if REQUIRE_DATA and lacks_data(reasons):
        terminalreporter.write_line("failed: ZENAV_REQUIRE_DATA=1, and tests on data were skipped", red=True)
    if SEED:
        terminalreporter.write_line(f"hypothesis seed {SEED}: run again with ZENAV_HYPOTHESIS_SEED={SEED}")
