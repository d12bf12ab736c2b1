# SPDX-License-Identifier: Apache-2.0
"""The link of benchmarks delays and drops IP packets, and a link that is cut carries none."""

import socket
import subprocess
import sys
import time

import pytest

from shared.config import UserError
from zenav.bench.lossy_link import LOST, lossy_link
from zenav.bench.site import LinkPhase, faults

ECHO = """
import socket, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo:
    echo.bind((sys.argv[1], 5005))
    print("ready", flush=True)
    while True:
        echo.sendto(*echo.recvfrom(100))
"""
N = 200


def returned(link, seconds):
    """How many of N packets come back within `seconds`, and how long the first one took, s."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((link.robot, 0))
        begun = time.monotonic()
        for i in range(N):
            probe.sendto(bytes([i % 256]), (link.site, 5005))
        n, first = 0, float("inf")
        while (left := begun + seconds - time.monotonic()) > 0 and n < N:
            probe.settimeout(left)
            try:
                probe.recv(100)
            except TimeoutError:
                break
            n, first = n + 1, min(first, time.monotonic() - begun)
        return n, first


def test_packets_are_late_and_lost_as_set_and_a_cut_link_carries_none():
    try:
        with (
            lossy_link(seed=1) as link,
            subprocess.Popen(
                link.inside(sys.executable, "-c", ECHO, link.site), stdout=subprocess.PIPE, text=True
            ) as echo,
        ):
            try:
                assert echo.stdout.readline() == "ready\n"
                assert returned(link, 5.0)[0] == N
                before = link.n_bytes[0]
                link.set(0.2, 0.1)
                n, first = returned(link, 5.0)
                assert first >= 0.4
                assert 0.7 * N < n < 0.92 * N, "81 % pass both ways; five deviations are 14 %"
                assert 0 <= link.n_bytes[0] - before - N * 29 < 500, (
                    "an IP head, a UDP head and a byte each; and IPv6 asks for routers"
                )
                link.set(0.0, LOST)
                assert returned(link, 0.5)[0] == 0
            finally:
                echo.kill()
    except UserError as error:
        pytest.skip(f"{error.what}: {error.hint}")


def phases(**changed):
    names = ("rest", "drives", "drives, link cut", "drives, link slow", "drives, link back", "drives, watched")
    made = [LinkPhase(name, 0, 10**10, sent=1000, received=1000, way=3.0, p50=5.0) for name in names]
    for name, change in changed.items():
        phase = next(phase for phase in made if phase.name.replace(", ", "_").replace(" ", "_") == name)
        for key, value in change.items():
            setattr(phase, key, value)
    return made


GOOD = {
    "orders": {"goal on the cut link": {"error": "no answer"}, "same task after it": True, "stop": {}, "release": {}}
}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rest": {"sent": 25_000}}, "rest: 2.6 kB/s, where 2 are the limit"),
        ({"drives_link_cut": {"way": 1.0}}, "less than half as far"),
        ({"drives_link_slow": {"stops": 2}}, "the guard stopped the robot"),
        ({"drives_link_slow": {"p50": 9.0}}, "1.80 times as late"),
    ],
)
def test_a_robot_that_the_link_disturbs_or_that_sends_too_much_is_a_fault(changed, words):
    assert faults(phases(), GOOD) == []
    (fault,) = faults(phases(**changed), GOOD)
    assert words in fault


def test_a_goal_of_the_cut_link_that_arrives_is_a_fault():
    late = {"orders": {**GOOD["orders"], "goal on the cut link": {"accepted": True}}}
    assert faults(phases(), late) == ["a goal of the cut link reached the robot"]
