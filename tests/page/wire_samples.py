# SPDX-License-Identifier: Apache-2.0
"""Bytes of messages for the page's tests, made by the codec: `python -m tests.page.wire_samples` writes them."""

import json
from pathlib import Path

import numpy as np

from shared import messages as m
from shared.codec import Envelope, encode
from shared.geometry import Pose2

FILE = Path(__file__).resolve().parents[2] / "web" / "test" / "wire_samples.json"
STAMP = 1_700_000_000_123_456_789
POSE = Pose2(1.5, -2.25, 0.5)
COVARIANCE = np.eye(3).ravel()


def messages() -> dict[str, m.Message]:
    """One message of each key that has arrays, poses or nested messages."""
    square = np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 2.0, 2.0])
    zone = m.Zone(STAMP, "stairs", m.ZoneKind.KEEP_OUT, *square)
    ranges = np.array([0.5, np.nan, np.inf, 3.25], np.float32)
    return {
        "scan": m.LaserScan(STAMP, -1.0, 0.5, 0.1, 0.05, 12.0, ranges),
        "odom": m.Odometry(STAMP, POSE, 0.25, -0.5, COVARIANCE),
        "pose": m.PoseEstimate(STAMP, POSE, Pose2(0.0, 0.0, 0.0), COVARIANCE, 0.875, m.Localization.GOOD),
        "plan": m.Path(STAMP, 7, 3, "", *square, np.zeros(4), 5.0, 6.5),
        "zones": m.Zones(STAMP, (zone,)),
        "guard/status": m.GuardStatus(STAMP, m.GuardState.HOLD, "nav", "obstacle", "0.21 m ahead", 0.5),
        "debug/costmap": m.Costmap(STAMP, -2.0, -2.0, 0.05, np.array([[0, 50, 100], [-1, 99, 1]], np.int8)),
        "debug/rollouts": m.Rollouts(
            STAMP, np.zeros((2, 3), np.float32), np.ones((2, 3), np.float32), np.array([1.0, 2.0], np.float32)
        ),
        "debug/graph": m.KeyframeGraph(
            STAMP,
            xs=np.array([0.0, 1.5], np.float32),
            ys=np.array([0.0, 2.5], np.float32),
            from_xs=np.array([0.0], np.float32),
            from_ys=np.array([0.0], np.float32),
            to_xs=np.array([1.5], np.float32),
            to_ys=np.array([2.5], np.float32),
            accepted=np.array([1], np.int8),
        ),
        "health/mapper": m.Health(
            STAMP, "mapper", 42, "mapping", 100, 0, 1, 0, "", 0.125, 61.5, 4.5, (("scan", 10.0, 0.004),)
        ),
        "estop": m.EmergencyStop(STAMP, True, "page 1"),
    }


def samples() -> dict[str, str]:
    """Key -> bytes in hexadecimal."""
    envelope = Envelope("mapper", "a", 5, STAMP)
    return {key: encode(message, envelope).hex() for key, message in messages().items()}


if __name__ == "__main__":
    FILE.write_text(json.dumps(samples(), indent=1) + "\n")
