# SPDX-License-Identifier: Apache-2.0
"""`zenav bench ros2`: its limits, and that messages pass the bridge in both directions."""

import json

import pytest

from shared.config import UserError
from zenav.bench.ros2 import MAX_CPU, MAX_IDLE_CPU, MAX_P99_MS, BridgeUsage, figures, ros2

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
    assert figures(scans, commands, idle, busy)["kept"] is kept


def test_a_bridge_that_passes_nothing_is_an_error():
    with pytest.raises(UserError, match="no message passed"):
        figures([], FAST, IDLE, BUSY)


def test_messages_pass_the_bridge_in_both_directions(tmp_path):
    out = tmp_path / "ros2.json"
    ros2(out, 1.0)
    report = json.loads(out.read_text())
    assert report["latency"]["/scan out"]["n"] > 0
    assert report["latency"]["/cmd_vel in"]["n"] > 0
    assert report["bridge"]["no subscriber"]["pss_mb"] > 1
