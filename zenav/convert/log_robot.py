# SPDX-License-Identifier: Apache-2.0
"""A robot that a log describes by its laser and its motion."""

from shared.config import Drive, Laser, Robot
from zenav.convert.content import mount_of, range_max_of
from zenav.convert.records import LoggedScan


def robot_of_log(scans: list[LoggedScan]) -> Robot:
    """The log's robot, as far as the log describes it: its laser, and a drive whose limits allow each logged motion."""
    first = scans[0]
    return Robot(
        name="log",
        footprint=((0.3, -0.3), (0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3)),
        drive=Drive(
            wheel_radius=0.1, wheel_distance=0.4, counts_per_turn=1000, encoder_wrap=65536, motor_direction=1,
            max_speed=3.0, max_reverse_speed=3.0, max_turn_rate=4.0, max_acceleration=3.0, max_braking=3.0,
            max_turn_acceleration=10.0,
        ),
        laser=Laser(
            mount=mount_of(scans), angle_min=first.angle_min, angle_increment=first.angle_increment,
            n_beams=len(first.ranges), scan_time=0.0, rate=5.0, range_min=0.05, range_max=range_max_of(scans),
        ),
    )  # fmt: skip
