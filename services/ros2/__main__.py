# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.ros2.bridge_device import KIND, bridge_device
from services.ros2.service import Ros2Service
from shared.runners import live

if __name__ == "__main__":
    live.main(Ros2Service, devices={KIND: bridge_device})
