# SPDX-License-Identifier: Apache-2.0
"""The Compose file: restarts after a reboot, settings that the services take; and what the image leaves out."""

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from shared.config import UserError, configured
from zenav.stack.service_loader import build_service

ROOT = Path(__file__).resolve().parents[2]
SERVICES = YAML(typ="safe").load(ROOT / "docker-compose.yml")["services"]
ENDS = {"map": "on-failure", "cli": "no"}


@pytest.mark.parametrize("name", SERVICES)
def test_a_container_is_started_again_after_a_reboot_unless_it_ends_by_itself(name):
    assert SERVICES[name]["restart"] == ENDS.get(name, "unless-stopped")


def settings(name, variables):
    """The assignments of `--set` in a service's command, as Compose expands them."""
    words = SERVICES[name]["command"]
    given = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    return [re.sub(r"\$\{(\w+):-([^}]*)\}", lambda m: variables.get(m[1]) or m[2], text) for text in given]


@pytest.mark.parametrize("robot", ["x80sv", "delivery"])
@pytest.mark.parametrize("name", ["sim", "emulator", "base_driver", "base_driver_serial", "lidar_driver", "imu_driver"])
def test_the_settings_of_a_container_suit_robots_with_one_and_with_two_lasers(name, robot):
    file = configured(robot, settings(name, {}))
    assert build_service(name.replace("emulator", "sim").removesuffix("_serial"), file, file.robot).ports is not None


def test_the_second_laser_is_on_its_own_device():
    file = configured("delivery", settings("lidar_driver", {"ZENAV_LASER": "/dev/a", "ZENAV_LASER_2": "/dev/b"}))
    ports = build_service("lidar_driver", file, file.robot).ports
    assert {port: config.device for port, config in ports.items()} == {"laser": "/dev/a", "laser_2": "/dev/b"}


def test_the_second_lasers_device_is_refused_on_a_robot_with_one():
    file = configured("x80sv", settings("lidar_driver", {"ZENAV_LASER_2": "/dev/b"}))
    with pytest.raises(UserError, match="has no second laser"):
        build_service("lidar_driver", file, file.robot)


def test_the_image_keeps_every_part_of_scipy_that_is_used():
    left_out = set(re.findall(r"scipy/(\w+)", (ROOT / "Dockerfile").read_text(encoding="utf-8")))
    sources = [
        path.read_text() for package in ("services", "shared", "zenav") for path in (ROOT / package).rglob("*.py")
    ]
    used = {name for source in sources for name in re.findall(r"scipy\.(\w+)", source)}
    assert {"ndimage", "optimize", "spatial", "linalg"} <= used
    assert left_out
    assert not left_out & used
