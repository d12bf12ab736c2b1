# SPDX-License-Identifier: Apache-2.0
"""The Compose file: what runs the robot is started again after a reboot, what ends by itself is not."""

from pathlib import Path

import pytest
from ruamel.yaml import YAML

SERVICES = YAML(typ="safe").load(Path(__file__).resolve().parents[2] / "docker-compose.yml")["services"]
ENDS = {"map": "on-failure", "cli": "no"}


@pytest.mark.parametrize("name", SERVICES)
def test_a_container_is_started_again_after_a_reboot_unless_it_ends_by_itself(name):
    assert SERVICES[name]["restart"] == ENDS.get(name, "unless-stopped")
