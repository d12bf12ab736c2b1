# SPDX-License-Identifier: Apache-2.0
"""A stack in the world `room` and a browser for the tests of a module, and pages that end with their test."""

from collections.abc import Iterator
from contextlib import chdir
from typing import Any

import pytest

from shared import topics
from shared.messages import EmergencyStop
from tests.stack.processes import ALL, StackProcesses, running


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StackProcesses]:
    """The stack of a module. Its working folder is empty, so it has no saved maps."""
    folder = tmp_path_factory.mktemp("page")
    with chdir(folder), running(folder / "logs", (*ALL, "dashboard")) as stack:
        stack.client.follow(topics.CMD_VEL, topics.GOAL, topics.ZONES, topics.ESTOP)
        stack.until(lambda: stack.client.latest(topics.CMD_VEL) and stack.client.latest(topics.TRUTH))
        yield stack


@pytest.fixture(scope="module")
def browser(stack: StackProcesses) -> Iterator[Any]:
    from tests.page.browser_page import chromium  # the stack comes first: it starts processes by fork

    with chromium() as browser:
        yield browser


@pytest.fixture
def pages(browser: Any, stack: StackProcesses) -> Iterator[Any]:
    """Pages of a test. Afterwards none of them had an error in its console, a fault or a violation of its policy."""
    from tests.page.browser_page import Pages

    stack.client.publish(topics.ESTOP(EmergencyStop(stack.client.now(), False, "test")))  # what a failed test left
    pages = Pages(browser, stack)
    yield pages
    pages.close()
    assert pages.problems == []
