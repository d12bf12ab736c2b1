# SPDX-License-Identifier: Apache-2.0
"""A stranger on the robot's network, in a network namespace: one port is open, and lets no stranger in."""

import json
import subprocess
import sys
from contextlib import contextmanager, suppress
from select import select

import psutil
import pytest

from shared.secure_folder import SecureFolder
from tests.stack.processes import ALL, ROBOT, running
from zenav.bench.gateway import free_endpoint, gateway_settings, member_subscriber, viewer_credentials
from zenav.bench.member_namespace import member_namespace

FROM_OUTSIDE = """
import json, socket, sys
address, *ports = sys.argv[1:]
reached = []
for port in ports:
    try:
        socket.create_connection((address, int(port)), 1.0).close()
        reached.append(int(port))
    except OSError:
        pass
print(json.dumps(reached))
"""


@contextmanager
def started(command):
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def listening_ports(stack):
    """TCP ports on which processes of the stack listen."""
    ports = set()
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it has just ended, as a short-lived child of a service does
            rows = process.net_connections("tcp")
            ports |= {row.laddr.port for row in rows if row.status == psutil.CONN_LISTEN}
    return sorted(ports)


def test_from_another_computer_only_the_gateway_is_reached_and_only_with_credentials(tmp_path):
    with member_namespace() as outside:
        if not outside.name:
            pytest.skip("needs root and `ip` for a network namespace")
        place = SecureFolder(tmp_path / "secure")
        viewer, address = viewer_credentials(place, "x80sv"), free_endpoint(outside)
        other = viewer_credentials(SecureFolder(tmp_path / "other" / "secure"), "x80sv")
        names = (*ALL, "dashboard", "gateway")
        with running(tmp_path, names, settings=tuple(gateway_settings(place, address))) as stack:
            open_to_all = int(address.rpartition(":")[2])
            stack.until(lambda: open_to_all in listening_ports(stack))
            ports = listening_ports(stack)
            assert len(ports) > len(ALL), "each service listens"
            command = outside.inside(sys.executable, "-c", FROM_OUTSIDE, outside.robot, *map(str, ports))
            reached = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
            assert reached == [open_to_all]

            def subscriber(credentials):
                return member_subscriber(outside, f"tls/{address}", credentials, f"{ROBOT.name}/**")

            with started(subscriber(other)) as stranger, started(subscriber(viewer)) as member:
                assert member.stdout.readline() == b"ready\n"
                stack.until(lambda: stack.healths["gateway"].rejected)
                stack.until(lambda: "1 member connected" in stack.healths["gateway"].state)
                assert not select([stranger.stdout], [], [], 0)[0], "another robot's member is let in"
