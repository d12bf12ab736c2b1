# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.navigator.service import NavigatorService
from shared.runners import live

if __name__ == "__main__":
    live.main(NavigatorService)
