# SPDX-License-Identifier: Apache-2.0
import shared.repeatable  # noqa: F401  # before numpy
from services.gateway.link_device import gateway_device
from services.gateway.service import GatewayService
from shared.runners import live

if __name__ == "__main__":
    live.main(GatewayService, devices={"tls": gateway_device})
