# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.local_ctrl.service import LocalCtrlService
from shared.runners import live

if __name__ == "__main__":
    live.main(LocalCtrlService)
