# SPDX-License-Identifier: Apache-2.0
"""`zenav site page`: the page of all robots, a client of the site's router."""

import sys

from services.dashboard.address import page_address
from services.dashboard.config import DashboardConfig
from shared.config import UserError, configured
from shared.runners.transport import stack_address
from zenav.stack.page import SERVICE, host_settings
from zenav.stack.up import run_service


def run_site_page(robot: str, local: str, host: str, settings: list[str], log: str) -> None:
    """Serves the page in this process until Ctrl-C. Does not return. robot: NAME@KIND, shown first.

    Raises UserError where `local` is no router, or the page lacks a certificate.
    """
    where = stack_address(local)
    if not where.router:
        raise UserError(f"{local} is no router", "write tcp/127.0.0.1:7447, as zenav site up shows it")
    own = [f"{SERVICE}.fleet=true", f"{SERVICE}.tools=''", *host_settings(host), *settings]
    address = page_address(configured(robot, own).section(SERVICE, DashboardConfig), where)
    sys.stderr.write(f"the page of the site is at {address.url} as soon as its service has started\n")
    run_service(SERVICE, robot, local, settings=own, clock="", memory="", log=log)
