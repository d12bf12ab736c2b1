# SPDX-License-Identifier: Apache-2.0
"""Tests with processes and sockets run one after the other, on one worker: they would take each other's processor."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.xdist_group("stack"))
