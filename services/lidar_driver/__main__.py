# SPDX-License-Identifier: Apache-2.0
from services.lidar_driver.service import LidarDriverService
from shared.runners import live

if __name__ == "__main__":
    live.main(LidarDriverService)
