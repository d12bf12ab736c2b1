# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.traffic.service import TrafficService
from shared.runners import live

if __name__ == "__main__":
    live.main(TrafficService)
