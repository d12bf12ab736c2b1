# SPDX-License-Identifier: Apache-2.0
"""The Python API for programs beside the stack: docs/api.md."""

from shared.runners.client import Client

__all__ = ["Client", "MapArray", "RobotConnection", "RobotPose", "TaskResult", "connect"]

# these modules take Client from here
from zenav.client.navigation_client import TaskResult
from zenav.client.robot_connection import MapArray, RobotConnection, RobotPose, connect
