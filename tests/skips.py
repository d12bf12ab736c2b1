# SPDX-License-Identifier: Apache-2.0
"""What tests were skipped for, and what provides it: the last lines of a run."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Need:
    """What tests may lack. words: any of them stands in the reasons of its skips. provided_by: what to do for it."""

    words: tuple[str, ...]
    provided_by: str


NO_TIME = "time is up"
DATA = Need(("ZENAV_DATA", "slam_eval.py"), "set ZENAV_DATA to the folder with slam, barn, planning, bags and x80sv")
NEEDS = (
    DATA,
    Need(("Docker", "docker"), "install Docker with Compose, and run make test-docker"),
    Need(("package index",), "run make test-wheel where pip reaches a package index"),
    Need(("ROS 2 environment",), "run make test-ros2 where pip reaches a package index, on x86-64"),
    Need(("evo",), "pip install -r requirements-dev.txt"),
    Need(("x86-64",), "run them on an x86-64 processor"),
    Need(("another processor",), "run them where the recordings were made, or make record-references"),
    Need(("cannot fork",), "run them on Linux"),
    Need(("Chromium",), "pip install -r requirements-dev.txt, and install Chromium (apt install chromium)"),
    Need(("axe-core", "Node"), "run npm ci in web/"),
    Need(("g++",), "install a C++ compiler (apt install g++)"),
    Need(("network namespace",), "run them as root, with iproute2"),
    Need(("64-bit",), "run them on a 64-bit computer"),
    Need(("SCHED_RR",), "allow real-time scheduling: ulimit -r, or run them as root"),
    Need(("control group", "needs root and systemd"), "run them as root, on a Linux with control groups and systemd"),
    Need(("history of commits",), "run them in a clone with all commits: git fetch --unshallow"),
    Need((NO_TIME,), "run make test, which has the time for all cases"),
    Need(("systemd-analyze",), "install systemd, which has systemd-analyze"),
)


def need_of(reason: str) -> Need:
    """What a reason to skip asks for; one of its own where no row of NEEDS knows it."""
    return next((need for need in NEEDS if any(word in reason for word in need.words)), Need((reason,), reason))


def lacks_data(reasons: Iterable[str]) -> bool:
    """Whether tests were skipped for want of the data."""
    return any(need_of(reason) is DATA for reason in reasons)


def lines(reasons: Iterable[str]) -> list[str]:
    """One line a need, the most tests first. reasons: one a skipped test."""
    counts = Counter(need_of(reason) for reason in reasons)
    return [
        f"{n} {'test' if n == 1 else 'tests'} skipped: {need.provided_by}"
        for need, n in sorted(counts.items(), key=lambda item: (-item[1], item[0].provided_by))
    ]
