# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.uplink.service import UplinkService
from services.uplink.site_device import site_device
from shared.runners import live

if __name__ == "__main__":
    live.main(UplinkService, devices={"tls": site_device})
