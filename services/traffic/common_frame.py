# SPDX-License-Identifier: Apache-2.0
"""The frame of the places and paths in the intents of robots.

On a map with a name it is `map`. Robots that explore together have a map each, without a name: it is the frame that
their shares of the exploration are in.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from shared.geometry import Pose2
from shared.messages import ExplorationShare, RobotIntent
from shared.types import NS_PER_S

EXPLORES_NS = 12 * NS_PER_S
"""ns for which a share counts: longer than the longest period between two."""


@dataclass(frozen=True, slots=True)
class CommonFrame:
    """Robots with the same name of it hear each other. Without a name there are no others."""

    name: str = ""
    common_from_map: Pose2 = field(default_factory=Pose2)


def common_frame(robot: str, map_name: str, share: ExplorationShare | None, now: int) -> CommonFrame:
    """The frame of a robot with its newest share, if it explores with others. now: ns."""
    if map_name or share is None or not 0 <= now - share.stamp < EXPLORES_NS:
        return CommonFrame(map_name)
    return CommonFrame(f"explored by {', '.join(sorted({robot, *share.others}))}", share.common_from_map)


def moved_intent(intent: RobotIntent, target_from_source: Pose2) -> RobotIntent:
    """An intent in another frame. The same message where the frames are the same."""
    if target_from_source == Pose2():
        return intent
    points = target_from_source @ np.column_stack((intent.xs, intent.ys)).astype(float)
    return replace(
        intent,
        map_from_base=target_from_source @ intent.map_from_base,
        xs=points[:, 0].astype(np.float32),
        ys=points[:, 1].astype(np.float32),
    )
