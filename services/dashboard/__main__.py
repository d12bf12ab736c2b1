# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.dashboard.service import DashboardService
from services.dashboard.web import web_device
from shared.runners import live

if __name__ == "__main__":
    live.main(DashboardService, devices={"web": web_device})
