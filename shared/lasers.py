# SPDX-License-Identifier: Apache-2.0
"""Which topic carries the scans of which laser?"""

from shared import topics
from shared.messages import LaserScan
from shared.robot import Laser, Robot
from shared.topics import Topic

SCAN_TOPICS = (topics.SCAN, topics.SCAN_2)
"""By the place in `robot.lasers`. Each has its own publisher, rate and age: so each laser is watched alone."""
NO_SECOND_LASER = "robot.lasers has no second laser"
"""Why a service does not use a message of SCAN_2."""


def lasers_by_topic(robot: Robot) -> dict[Topic[LaserScan], Laser]:
    """The robot's lasers by the topic of their scans, the first one first."""
    return dict(zip(SCAN_TOPICS, robot.all_lasers, strict=False))


def laser_mounts(robot: Robot) -> dict[str, list[float]]:
    """x, y (m) and yaw (rad) of each laser in `base`, under the names of the page's protocol."""
    poses = [[laser.mount.x, laser.mount.y, laser.mount.yaw] for laser in robot.all_lasers]
    return dict(zip(("laser_mount", "laser_2_mount"), poses, strict=False))


def about_laser(laser: Laser, words: str) -> str:
    """Words about a laser, with its name where it has one."""
    return ": ".join(filter(None, (f"laser {laser.name}" if laser.name else "", words)))
