# SPDX-License-Identifier: Apache-2.0
"""The boards by `base_driver.board.model`."""

from collections.abc import Callable

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardDevice
from services.base_driver.boards.drrobot_board import DrRobotBoard
from services.base_driver.boards.velocity import VelocityBoard
from shared.config import Robot

BOARDS: dict[str, Callable[[SerialBoardConfig, Robot], BoardDevice]] = {
    "drrobot": DrRobotBoard,
    "velocity": VelocityBoard,
}
