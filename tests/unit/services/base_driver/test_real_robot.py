# SPDX-License-Identifier: Apache-2.0
"""A drive of a real X80SV on 2014-12-17, from its encoder counts to the pose.

The emulated board, base driver and odometry give the poses that the robot's own driver computed.
"""

import csv
import gzip
import os
from math import hypot, pi, radians
from pathlib import Path

import pytest

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from services.sim.hardware.drrobot import motor_sensor
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import PortState, SerialData

ROBOT = load_robot("x80sv").robot
DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where recordings are, for tests alone
needs_data = pytest.mark.skipif(DATA is None, reason="ZENAV_DATA is not set: the folder of recordings")

# fmt: off
SLICE = (
    (74.700235, 587, 8971, 1.8172387, -0.1836168, -1.3137543),
    (74.801053, 542, 9010, 1.8247815, -0.2123126, -1.3287308),
    (74.900192, 494, 9054, 1.8325711, -0.2438615, -1.3387158),
    (75.000116, 447, 9095, 1.8397205, -0.2741116, -1.3536923),
    (75.100572, 399, 9136, 1.8464920, -0.3048104, -1.3711636),
    (75.200224, 351, 9177, 1.8527262, -0.3356227, -1.3886349),
    (75.300792, 304, 9219, 1.8584212, -0.3665393, -1.4011147),
    (75.400561, 259, 9261, 1.8636106, -0.3968282, -1.4086030),
    (75.501732, 213, 9304, 1.8686871, -0.4278523, -1.4160912),
    (75.600648, 166, 9346, 1.8735312, -0.4589136, -1.4285710),
    (75.701038, 120, 9390, 1.8780373, -0.4903825, -1.4335644),
    (75.800593, 74, 9432, 1.8822896, -0.5211738, -1.4435494),
    (75.900218, 29, 9473, 1.8861446, -0.5513052, -1.4535344),
    (76.000325, 32754, 9514, 1.8896159, -0.5807721, -1.4585278),
    (76.100591, 32714, 9551, 1.8926630, -0.6077989, -1.4660161),
    (76.202269, 32676, 9585, 1.8953229, -0.6330914, -1.4760010),
    (76.300676, 32643, 9614, 1.8973959, -0.6548928, -1.4859860),
    (76.400544, 32616, 9638, 1.8989219, -0.6728423, -1.4934743),
    (76.500477, 32592, 9662, 1.9002315, -0.6897463, -1.4934743),
    (76.600537, 32568, 9687, 1.9015684, -0.7070025, -1.4909775),
    (76.700382, 32545, 9712, 1.9029202, -0.7239031, -1.4859841),
    (76.800272, 32521, 9734, 1.9042966, -0.7400929, -1.4909775),
    (76.900230, 32498, 9757, 1.9055922, -0.7562893, -1.4909775),
    (77.000508, 32473, 9781, 1.9069722, -0.7735420, -1.4934743),
)
# fmt: on
"""A curve during which the left counter wraps: s, left counts, right counts, and the recorded pose x, y, yaw."""


def poses(times, counts):
    """The pose after each reading, as the robot's own driver computes it. Each packet arrives in two pieces."""
    driver = BaseDriverService(BaseDriverConfig.model_validate({"port": {"device": "wired"}}), ROBOT)
    odometry = OdometryService(DeadReckoningConfig(integration="document"), ROBOT)
    list(driver.port(PortState(0, "board", True, "")))
    found = []
    for t, (left, right) in zip(times, counts):
        driver.now = odometry.now = round(t * 1e9)
        packet = motor_sensor((left, right), (0.0, 0.0), (0.0, 0.0))
        for part in (packet[:17], packet[17:]):
            for publication in driver.receive_bytes(SerialData(driver.now, "board", part)):
                if publication.topic is topics.WHEELS:
                    found += [out.message.odom_from_base for out in odometry.wheels(publication.message)]
    assert driver.serial.device.deframer.n_good == len(times)
    assert driver.serial.device.deframer.n_skipped == 0
    assert driver.encoders.n_jumps == 0
    return found


def compared(recorded, found):
    """Largest distance (m) and turn (rad) between recorded poses and ours, which begin at the first of them."""
    assert len(found) == len(recorded)
    ours = [recorded[0] @ pose for pose in found]
    far = max(hypot(a.x - b.x, a.y - b.y) for a, b in zip(recorded, ours))
    return far, max(abs(wrapped(a.yaw - b.yaw)) for a, b in zip(recorded, ours))


def test_a_curve_of_the_real_robot_comes_out_of_its_packets():
    recorded = [Pose2(*row[3:]) for row in SLICE]
    far, turned = compared(recorded, poses([row[0] for row in SLICE], [row[1:3] for row in SLICE]))
    assert far < 1e-5
    assert turned < 1e-5
    assert recorded[0].distance(recorded[-1]) > 0.5


@needs_data
def test_the_real_robot_s_whole_drive_comes_out_of_its_packets():
    def rows(name):
        with gzip.open(Path(DATA) / "x80sv" / f"{name}.csv.gz", "rt") as file:
            return [[float(value) for value in row] for row in list(csv.reader(file))[1:]]

    wheels = rows("wheel_positions")
    recorded = [Pose2(*row[2:5]) for row in rows("odom")][1:]  # its row 0 has no wheel row
    n = min(len(recorded), len(wheels))
    assert wheels[n - 1][0] > 272
    counts = [tuple(round(angle * 756 / (2 * pi)) % 32768 for angle in row[1:]) for row in wheels[:n]]
    far, turned = compared(recorded[:n], poses([row[0] for row in wheels[:n]], counts))
    assert far < 0.001
    assert turned < radians(0.1)
