# SPDX-License-Identifier: Apache-2.0
from services.navigator.service import NavigatorService
from shared.runners import live

if __name__ == "__main__":
    live.main(NavigatorService)
