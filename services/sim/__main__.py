# SPDX-License-Identifier: Apache-2.0
from services.sim.service import SimService
from shared.runners import live

if __name__ == "__main__":
    live.main(SimService)
