# SPDX-License-Identifier: Apache-2.0
"""What the footprint counts, and how a figure is held against its limit."""

import mmap
import os
import signal

import psutil
import pytest

from zenav.bench.footprint import MAX_CPU, MAX_PSS_MB, Usage, figures, memory

COMMANDS = {"--help": (0.2, 0.15), "topic list": (0.24, 0.2)}
LIGHT = {
    "zenav up": Usage(20.0, 10.0, 100.0, 0.02),
    "guard": Usage(30.0, 15.0, 150.0, 0.1),
    "recorder": Usage(30.0, 15.0, 150.0, 5.0),
    "sim": Usage(900.0, 800.0, 950.0, 7.0),
}


def exceeded(report: dict) -> list[str]:
    return [row["what"] for row in report["limits"] if not row["within"]]


def test_the_simulator_counts_for_nothing_and_the_recorder_for_memory_only():
    report = figures(LIGHT, {"guard": [0.3, 0.4, 0.2]}, 3.0, COMMANDS)
    assert report["summary"]["pss_mb"] == 80.0
    assert report["summary"]["cpu"] == pytest.approx(0.12)
    assert exceeded(report) == []


@pytest.mark.parametrize(
    ("usage", "restart", "motion", "wall", "what"),
    [
        (Usage(MAX_PSS_MB + 1, 1.0, 1.0), 0.1, 1.0, 0.1, "PSS"),
        (Usage(1.0, 1.0, 1.0, MAX_CPU + 0.01), 0.1, 1.0, 0.1, "CPU"),
        (Usage(1.0, 1.0, 1.0), 0.51, 1.0, 0.1, "restart"),
        (Usage(1.0, 1.0, 1.0), 0.1, 4.1, 0.1, "first motion"),
        (Usage(1.0, 1.0, 1.0), 0.1, 1.0, 0.26, "--help"),
    ],
)
def test_each_figure_beyond_its_limit_is_named(usage, restart, motion, wall, what):
    report = figures({"guard": usage}, {"guard": [restart]}, motion, {"--help": (wall, 0.1)})
    (found,) = exceeded(report)
    assert what in found


def test_a_restart_counts_by_the_slowest_service_and_its_median():
    report = figures(LIGHT, {"guard": [0.1, 9.0, 0.1], "mapper": [0.3, 0.3, 0.3]}, 1.0, COMMANDS)
    assert report["summary"]["restart_s_slowest_median"] == 0.3


def test_pages_that_a_child_shares_are_not_its_own():
    size = 64 * 2**20
    with mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE) as block:
        block.write(b"x" * size)
        alone = memory(os.getpid())
        child = os.fork()
        if child == 0:
            signal.pause()
        try:
            both = memory(os.getpid())
            assert both.rss == pytest.approx(alone.rss, rel=0.05)
            assert alone.pss - both.pss > 0.4 * size / 1e6
            assert alone.uss - both.uss > 0.9 * size / 1e6
        finally:
            psutil.Process(child).kill()
            os.waitpid(child, 0)
