# SPDX-License-Identifier: Apache-2.0
"""Repeatable arithmetic, before anything imports numpy; repeatable examples, however busy the machine is."""

import shared.repeatable  # noqa: F401

# isort: split
from hypothesis import HealthCheck, settings

settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("steady", settings.get_profile("explore"), derandomize=True)
settings.load_profile("steady")  # the same examples each time; new ones: make test ARGS="--hypothesis-profile explore"
