# SPDX-License-Identifier: Apache-2.0
"""The Compose file on a real engine: it builds, becomes healthy, and a goal from the cli container is reached."""

import os
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = f"zenavtest{os.getpid()}"
SERVICES = {"router", "sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator"}
SERVICES |= {"recorder", "dashboard"}
DIES = """
import os, pathlib
for process in pathlib.Path("/proc").glob("[0-9]*"):
    if b"services.odometry" in (process / "cmdline").read_bytes().split(b"\\0"):
        os.kill(int(process.name), 9)
"""


def compose_command() -> list[str]:
    """Compose as the engine's plugin (v2), or the older program; nothing where there is neither."""
    plugin = ["docker", "compose"]
    if subprocess.run([*plugin, "version"], capture_output=True, timeout=30).returncode == 0:
        return plugin
    return ["docker-compose"] if shutil.which("docker-compose") else []


def missing() -> str:
    """Why Compose cannot be tested here; empty where it can."""
    if shutil.which("docker") is None:
        return "there is no docker here: sudo apt install docker.io docker-compose"
    if subprocess.run(["docker", "info"], capture_output=True, timeout=30).returncode != 0:
        return "no Docker engine answers: see docker info"
    return "" if compose_command() else "there is no Compose here: sudo apt install docker-compose"


MISSING = missing()
pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING or "-"), pytest.mark.timeout(1500)]


def compose(*arguments: str) -> str:
    """What Compose says; the test fails with it where Compose fails."""
    command = [*compose_command(), "-p", PROJECT, *arguments]
    done = subprocess.run(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if done.returncode != 0:
        pytest.fail(f"{' '.join(command)} ended with {done.returncode}\n{done.stdout[-5000:]}", pytrace=False)
    return done.stdout


@contextmanager
def events(kind: str, seconds: float) -> Iterator[Iterator[list[str]]]:
    """(container's service, event) of this project from now on; they end after `seconds`."""
    label = f"label=com.docker.compose.project={PROJECT}"
    form = '{{index .Actor.Attributes "com.docker.compose.service"}} {{.Action}}'
    command = ["docker", "events", "--filter", label, "--filter", f"event={kind}", "--format", form]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        end = threading.Timer(seconds, process.kill)
        end.start()
        try:
            yield (line.split(maxsplit=1) for line in process.stdout)
        finally:
            end.cancel()
            process.kill()


def healthy(names: set[str], heard: Iterator[list[str]]) -> set[str]:
    """Which of these services became healthy before the events ended."""
    left = set(names)
    for name, action in heard:
        if action.strip() == "health_status: healthy":
            left.discard(name)
        if not left:
            break
    return names - left


@pytest.fixture(scope="module", autouse=True)
def image() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch, socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        patch.setenv("ZENAV_PORT", str(s.getsockname()[1]))
        s.close()
        compose("build", "router")
        yield


@pytest.fixture
def down() -> Iterator[None]:
    yield
    profiles = [word for name in ("sim", "cli", "hardware", "emulated") for word in ("--profile", name)]
    compose(*profiles, "down", "--volumes", "--timeout", "5")


def test_the_image_runs_as_nobody_special_and_holds_its_kernels():
    def run(*command: str) -> str:
        return subprocess.run(["docker", "run", "--rm", "zenav", *command], capture_output=True, text=True).stdout

    assert run("id", "-u").strip() == "1000"
    compiled = "find /opt/zenav/kernels -name '*.nbc' | wc -l"
    before = int(run("sh", "-c", compiled))
    assert before > 20
    assert int(run("sh", "-c", f"python -m zenav.stack.warm > /dev/null && {compiled}")) == before


def test_the_stack_is_healthy_and_a_goal_from_the_command_line_is_reached(down):
    with events("health_status", 180) as heard:
        compose("up", "--detach")
        assert healthy(SERVICES, heard) == SERVICES
    told = compose("run", "--rm", "-T", "cli", "goto", "1.5", "0")
    assert "reached" in told.lower()
    with events("health_status", 120) as heard:
        compose("exec", "-T", "odometry", "python", "-c", DIES)  # the engine starts it again
        assert healthy({"odometry"}, heard) == {"odometry"}
    compose("run", "--rm", "-T", "cli", "goto", "0", "0")
    assert ".mcap" in compose("exec", "-T", "recorder", "ls", "recordings")
    compose("run", "--rm", "-T", "cli", "map", "save", "office")
    assert "map.pgm" in compose("run", "--rm", "-T", "--entrypoint", "ls", "cli", "maps/office")


def test_single_services_bring_the_router_and_nothing_else(down):
    with events("health_status", 120) as heard:
        compose("up", "--detach", "sim", "mapper")
        assert healthy({"router", "sim", "mapper"}, heard) == {"router", "sim", "mapper"}
    assert set(compose("ps", "--services", "--filter", "status=running").split()) == {"router", "sim", "mapper"}


def test_the_hardware_profile_drives_a_robot_behind_emulated_ports(down, monkeypatch):
    monkeypatch.setenv("ZENAV_BOARD", "socket://emulator:4001")
    monkeypatch.setenv("ZENAV_LASER", "socket://emulator:4002")
    on_robot = (SERVICES - {"sim", "base_driver"}) | {"emulator", "base_driver_serial", "lidar_driver"}
    with events("health_status", 180) as heard:
        compose("--profile", "hardware", "--profile", "emulated", "up", "--detach")
        assert healthy(on_robot, heard) == on_robot
    assert "reached" in compose("run", "--rm", "-T", "cli", "goto", "1.5", "0").lower()


def test_the_hardware_profile_is_the_stack_without_the_simulator():
    services = set(compose("--profile", "hardware", "config", "--services").split())
    assert services >= SERVICES - {"sim", "base_driver"} | {"base_driver_serial", "lidar_driver"}
    assert '"sim"' not in services
