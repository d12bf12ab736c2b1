# SPDX-License-Identifier: Apache-2.0
from services.imu_driver.service import ImuDriverService
from shared.runners import live

if __name__ == "__main__":
    live.main(ImuDriverService)
