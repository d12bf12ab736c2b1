# SPDX-License-Identifier: Apache-2.0
"""A base driver and an emulated board of any model on its port; the wheels turn as the board commands them."""

from math import pi

import numpy as np

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.sim.hardware.board import make_board
from services.sim.hardware.electronics import BodyTruth
from services.sim.hardware.faults import ActiveFaults
from shared import topics
from shared.config import load_robot
from shared.messages import BoardReport, PortState, SerialData, Velocity
from tests.strategies import faults as message_faults

MS = 1_000_000
T0 = 1_000_000 * MS
WRAPS = {
    "drrobot": 32768,
    "velocity": 1 << 31,
    "kobuki": 65536,
    "create2": 65536,
    "ros_arduino_bridge": 1 << 31,
    "roboclaw": 1 << 31,
    "odrive": 1 << 31,
}

MODELS = tuple(WRAPS)


def robot_of(model, kind="differential"):
    """An X80SV with another board."""
    robot = load_robot("x80sv").robot
    drive = robot.drive.model_copy(update={"encoder_wrap": WRAPS[model], "kind": kind})
    ranges = robot.ranges if model == "drrobot" else ()
    return robot.model_copy(update={"drive": drive, "ranges": ranges})


class WiredBoard:
    """Both ends of a line, and the wheels. left, right: counts that the wheels have turned, positive forward."""

    def __init__(self, model, left=1000.0, right=2000.0, kind="differential", **board):
        self.robot = robot_of(model, kind)
        values = {"port": {"device": "/dev/ttyUSB0"}, "board": {"model": model, **board}, "battery": {"empty": 6.0}}
        self.service = BaseDriverService(BaseDriverConfig.model_validate(values), self.robot)
        self.service.now = T0
        self.faults = ActiveFaults()
        self.board = make_board(model, self.faults, 1, self.robot)
        self.left, self.right, self.first = left, right, (left, right)
        self.battery = 7.4
        self.out = []
        self.is_connected = True
        self.damage = None  # changes the next bytes for the driver
        self.body = BodyTruth()
        self.take(self.service.port(PortState(T0, "board", True, "")))

    @property
    def now(self):
        return self.service.now

    @property
    def rates(self):
        """Counts/s of both wheels, positive forward."""
        left, right, _ = self.board.motors(self.now)
        return -left, right

    @property
    def rims(self):
        """m/s of both rims."""
        drive = self.robot.drive
        per_count = 2 * pi / drive.counts_per_turn
        return self.rates[0] * per_count * drive.left_radius, self.rates[1] * per_count * drive.right_radius

    def take(self, outputs):
        for publication in outputs:
            assert not list(message_faults(publication.message))
            self.out.append((publication.topic.key, publication.message))
            if publication.topic is topics.TX and self.is_connected:
                self.say(self.board.receive(publication.message.data, self.now))

    def say(self, data):
        if data and self.damage is not None:
            data, self.damage = self.damage(data), None
        if data:
            self.take(self.service.receive_bytes(SerialData(self.now, "board", data)))

    def truth(self):
        wrap, n = self.robot.drive.encoder_wrap, len(self.robot.ranges)
        ranges = np.full(3 if n else 0, 0.5, np.float32), np.full(7 if n else 0, 0.3, np.float32)
        counts = -round(self.left) % wrap, round(self.right) % wrap
        left, right = self.rates
        return BoardReport(self.now, *counts, -left, right, *ranges, self.battery, np.zeros(2, np.float32))

    def run(self, seconds, v=None, w=0.0):
        for _ in range(round(seconds * 50)):
            if v is not None:
                self.take(self.service.command(Velocity(self.now, v, w, "")))
            self.take(self.service.drive())
            left, right = self.rates
            self.service.now += 20 * MS
            self.left, self.right = self.left + left * 0.02, self.right + right * 0.02
            if self.is_connected:
                self.say(self.board.report_bytes(self.truth(), self.now, self.body))
        return self

    def last(self, topic):
        return next((message for key, message in reversed(self.out) if key == topic.key), None)

    def status(self):
        self.take(self.service.publish_status())
        return self.last(topics.BASE_STATUS)

    def turned(self):
        """rad that both wheels have turned since the start, as they did and as the driver counted."""
        rad = 2 * pi / self.robot.drive.counts_per_turn
        true = (self.left - self.first[0]) * rad, (self.right - self.first[1]) * rad
        wheels = self.last(topics.WHEELS)
        return true, (wheels.left, wheels.right)
