# SPDX-License-Identifier: Apache-2.0
"""`zenav bench ros2`: its limits, and that messages pass the bridge in each direction of both uses."""

import json

import pytest

from shared.config import UserError
from zenav.bench.ros2 import MAX_CPU, MAX_IDLE_CPU, MAX_P99_MS, NO_SUBSCRIBER, BridgeUsage, figures, ros2

IDLE, BUSY = BridgeUsage(MAX_IDLE_CPU / 2, 40.0), BridgeUsage(MAX_CPU / 2, 40.0)
FAST, SLOW = [1.0] * 100, [1.0] * 90 + [2 * MAX_P99_MS] * 10


@pytest.mark.parametrize(
    ("scans", "commands", "idle", "busy", "kept"),
    [
        (FAST, FAST, IDLE, BUSY, True),
        (SLOW, FAST, IDLE, BUSY, False),
        (FAST, SLOW, IDLE, BUSY, False),
        (FAST, FAST, BridgeUsage(2 * MAX_IDLE_CPU, 40.0), BUSY, False),
        (FAST, FAST, IDLE, BridgeUsage(2 * MAX_CPU, 40.0), False),
    ],
)
def test_the_limits_of_latency_and_cpu_decide(scans, commands, idle, busy, kept):
    assert figures({"/scan in": scans, "/cmd_vel out": commands}, {NO_SUBSCRIBER: idle, "busy": busy})["kept"] is kept


def test_a_bridge_that_passes_nothing_is_an_error():
    with pytest.raises(UserError, match="no message of /scan in passed"):
        figures({"/scan in": [], "/cmd_vel out": FAST}, {})


def test_messages_pass_the_bridge_of_a_robot_that_is_seen_and_of_one_that_is_driven(tmp_path):
    out = tmp_path / "ros2.json"
    ros2(out, 1.0)
    report = json.loads(out.read_text())
    assert set(report["latency"]) == {"/scan out", "/cmd_vel in", "/scan in", "/cmd_vel out"}
    assert all(0 < row["p50_ms"] <= row["p99_ms"] for row in report["latency"].values())
    assert report["bridge"][NO_SUBSCRIBER]["pss_mb"] > 1
