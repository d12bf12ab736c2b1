# SPDX-License-Identifier: Apache-2.0
"""The boards by `base_driver.board.model`."""

from collections.abc import Callable

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.create2 import Create2Board
from services.base_driver.boards.device import BoardDevice
from services.base_driver.boards.drrobot_board import DrRobotBoard
from services.base_driver.boards.kobuki import KobukiBoard
from services.base_driver.boards.odrive import OdriveBoard
from services.base_driver.boards.roboclaw import RoboclawBoard
from services.base_driver.boards.ros_arduino_bridge import RosArduinoBridgeBoard
from services.base_driver.boards.velocity import VelocityBoard
from shared.config import Robot

BOARDS: dict[str, Callable[[SerialBoardConfig, Robot], BoardDevice]] = {
    "drrobot": DrRobotBoard,
    "velocity": VelocityBoard,
    "kobuki": KobukiBoard,
    "create2": Create2Board,
    "ros_arduino_bridge": RosArduinoBridgeBoard,
    "roboclaw": RoboclawBoard,
    "odrive": OdriveBoard,
}
MODELS_WITH_GYRO = ("velocity", "kobuki")
MODELS_WITH_ODOMETRY = ("velocity",)
"""Boards that a base with robot.drive.kind velocity may have: the others only count wheels."""
