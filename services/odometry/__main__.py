# SPDX-License-Identifier: Apache-2.0
from services.odometry.service import OdometryService
from shared.runners import live

if __name__ == "__main__":
    live.main(OdometryService)
