# SPDX-License-Identifier: Apache-2.0
"""What a container stack stands on: the router's process, a service as its client, and the health check."""

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from shared.runners.transport import opened, stack_address
from zenav.stack.healthcheck import health_problem


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


@pytest.fixture
def router(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "zenav.stack.router", endpoint]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == f"router: listening on {endpoint}\n"
        yield process
        process.kill()


@pytest.fixture
def odometry(router: subprocess.Popen[str], endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    heard = threading.Event()
    with opened(stack_address(endpoint)) as session:
        session.declare_subscriber("*/health/odometry", lambda _: heard.set())
        with subprocess.Popen([sys.executable, "-m", "services.odometry", "--stack", endpoint]) as process:
            try:
                assert heard.wait(30)
                yield process
            finally:
                process.kill()


def test_a_service_that_works_is_healthy_and_one_that_hangs_is_not(odometry, endpoint):
    assert health_problem("odometry", endpoint) == ""
    odometry.send_signal(signal.SIGSTOP)
    try:
        assert health_problem("odometry", endpoint) == "no health message of odometry within 3 s"
    finally:
        odometry.send_signal(signal.SIGCONT)


def test_the_health_check_is_a_command_with_a_status_and_a_line(router, endpoint):
    def check(name: str, stack: str) -> tuple[int, str]:
        command = [sys.executable, "-m", "zenav.stack.healthcheck", name]
        done = subprocess.run(command, env={"ZENAV_STACK": stack}, capture_output=True, text=True, timeout=30)
        return done.returncode, done.stdout

    assert check("router", endpoint) == (0, "healthy\n")
    assert check("mapper", endpoint) == (1, "no health message of mapper within 3 s\n")
    nowhere = "tcp/127.0.0.1:1"
    assert check("router", nowhere) == (1, f"no router answers at {nowhere}\n")


def test_the_router_ends_at_once_when_it_is_told_to(router):
    router.send_signal(signal.SIGTERM)
    assert router.wait(5) == 0


def test_a_router_whose_port_is_taken_says_so(router, endpoint):
    command = [sys.executable, "-m", "zenav.stack.router", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert done.returncode == 2
    assert done.stderr.startswith(f"router: cannot listen on {endpoint}: ")
    assert done.stderr.endswith("hint: is the port taken? see: ss -tlnp\n")
