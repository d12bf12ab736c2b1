# SPDX-License-Identifier: Apache-2.0
"""Intents of robots for the tests of traffic."""

from dataclasses import replace

import numpy as np

from shared.geometry import Pose2
from shared.messages import RobotIntent

ORIGIN = Pose2()


def intent(stamp, name="blue", at=ORIGIN, path=(), **changes):
    """The intent of a robot at a pose. path: its points, m."""
    points = np.array(path, np.float32).reshape(-1, 2)
    message = RobotIntent(
        stamp=stamp,
        robot=name,
        map="office",
        map_from_base=at,
        v=0.0,
        w=0.0,
        radius=0.3,
        xs=points[:, 0].copy(),
        ys=points[:, 1].copy(),
        widths=np.zeros(len(points), np.float32),
        held=min(1, len(points)),
        wanted=len(points),
        priority=0,
        since=1,
        claim=1,
        heard=(),
        waits_for=(),
        gives_way=False,
        stuck=False,
        lost=False,
    )
    return replace(message, **changes)
