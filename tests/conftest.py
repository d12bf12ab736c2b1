# SPDX-License-Identifier: Apache-2.0
"""Repeatable arithmetic, before anything imports numpy; repeatable examples, however busy the machine is."""

import shared.repeatable  # noqa: F401

# isort: split
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.workers import Groups

settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("steady", settings.get_profile("explore"), derandomize=True)
settings.load_profile("steady")  # the same examples each time; new ones: make test ARGS="--hypothesis-profile explore"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: Any, log: Any) -> Groups:
    """How tests are shared out among workers."""
    return Groups(config, log)
