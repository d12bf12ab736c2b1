# SPDX-License-Identifier: Apache-2.0
"""The Compose file on a real engine: it builds, becomes healthy, and a goal from the cli container is reached."""

import os
import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shared import requests, topics
from shared.credentials import parsed_credentials
from shared.geometry import Pose2
from shared.requests import Navigate
from shared.runners.transport import StackAddress
from shared.secure_folder import MemberRole, SecureFolder
from zenav.client import Client
from zenav.secure import members

ROOT = Path(__file__).resolve().parents[2]
PROJECT = f"zenavtest{os.getpid()}"
SERVICES = {"router", "sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator"}
SERVICES |= {"recorder", "dashboard", "traffic"}
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


def compose(*arguments: str, statuses: tuple[int, ...] = (0,)) -> str:
    """What Compose says; the test fails with it where Compose ends with another status."""
    command = [*compose_command(), "-p", PROJECT, *arguments]
    done = subprocess.run(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if done.returncode not in statuses:
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


def answers(port: int) -> bool:
    """Whether a TLS server answers there: behind a port of a container without one, the engine closes connections."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with socket.create_connection(("127.0.0.1", port), 3.0) as line, context.wrap_socket(line) as session:
            return session.version() is not None
    except OSError:
        return False


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
    profiles = [word for name in ("sim", "cli", "hardware", "emulated", "remote") for word in ("--profile", name)]
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
        # the engine starts it again; this process may end with its container
        compose("exec", "-T", "odometry", "python", "-c", DIES, statuses=(0, 137))
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


def test_a_member_drives_through_the_gateway_and_without_the_folder_its_port_stays_closed(down, monkeypatch, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    monkeypatch.setenv("ZENAV_GATEWAY", f"127.0.0.1:{port}")
    monkeypatch.setenv("ZENAV_SECURE", str(tmp_path / "none"))
    (tmp_path / "none").mkdir()
    stack = ("--profile", "sim", "--profile", "remote", "up", "--detach", "gateway", *sorted(SERVICES))
    with events("health_status", 180) as heard:
        compose(*stack)
        assert healthy({*SERVICES}, heard) == SERVICES
    assert not answers(port)
    place = SecureFolder(tmp_path / "secure")
    members.init_folder("x80sv", str(place.path), [])
    members.add_member("anna", MemberRole.OPERATOR, str(place.path), tmp_path / "anna.pem", 1)
    for path in (place.path, *place.path.rglob("*")):
        os.chown(path, 1000, 1000)  # the container's user
    monkeypatch.setenv("ZENAV_SECURE", str(place.path))
    with events("health_status", 180) as heard:
        compose(*stack)
        assert healthy({"gateway"}, heard) == {"gateway"}
    anna = parsed_credentials((tmp_path / "anna.pem").read_text(), "anna.pem")
    assert answers(port)
    with Client(anna.robot, StackAddress(router=f"tls/127.0.0.1:{port}", credentials=anna)) as client:
        client.follow(topics.POSE)
        assert client.wait(topics.POSE, lambda _: True, 20) is not None
        reply = client.ask(requests.NAVIGATE, Navigate(client.now(), (Pose2(0.5, 0.0, 0.0),), 0.0, 1, True))
        assert reply.accepted, reply


def test_the_hardware_profile_is_the_stack_without_the_simulator():
    services = set(compose("--profile", "hardware", "config", "--services").split())
    assert services >= SERVICES - {"sim", "base_driver"} | {"base_driver_serial", "lidar_driver"}
    assert '"sim"' not in services
